"""The base station: refines the map, builds the grid, and sends back what it made."""
