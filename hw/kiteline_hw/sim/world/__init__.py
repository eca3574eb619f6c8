"""Scene name, seed and trajectories enter; the textured world and the smooth path of the vehicle leave."""
