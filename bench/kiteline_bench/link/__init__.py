"""Benchmarks of the codec and the link: flights over thin links and damaged bytes enter, bars leave."""
