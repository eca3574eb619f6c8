"""True occupancy: a world and true camera poses enter; grids of what is solid, and of what could be seen, leave."""
