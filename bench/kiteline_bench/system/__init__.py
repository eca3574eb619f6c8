"""Benchmarks of the whole: the first flight, the sources, and an older build enter, bars leave."""
