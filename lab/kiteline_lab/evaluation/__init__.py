"""Estimated and true trajectories enter; their errors (ATE, RPE, drift, coverage) leave."""
