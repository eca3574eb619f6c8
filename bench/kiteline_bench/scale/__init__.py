"""Benchmarks of size: many agents, large maps, long days."""
