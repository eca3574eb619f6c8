"""Occupancy grids as files of map_server: read, judged against the truth, drawn, and planned on."""
