"""Occupancy grids against the truth: flights and true worlds enter; bars on precision, recall and cost leave."""
