"""Experiments: fly, evaluate, benchmark, plot."""
