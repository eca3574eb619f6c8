"""Occupancy grids: files of map_server and true worlds enter; precision, recall, pictures and paths leave."""
