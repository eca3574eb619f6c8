"""Benchmarks of size: many agents, large maps and long days enter, bars leave."""
