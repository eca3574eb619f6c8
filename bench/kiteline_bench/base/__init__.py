"""Benchmarks of the base station: flights of one or several agents enter, bars leave."""
