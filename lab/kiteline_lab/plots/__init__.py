"""Plots: trajectories and maps go in, PNG files come out."""
