"""Benchmarks of the onboard agent: recordings and simulated flights enter, bars leave."""
