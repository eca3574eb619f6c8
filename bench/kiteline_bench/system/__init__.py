"""Benchmarks of the whole: the first flight, and the sources compared with an older build."""
