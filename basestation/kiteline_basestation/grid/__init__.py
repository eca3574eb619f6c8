"""The occupancy grid: placed keyframes with column scans or landmarks enter; tiles and map_server files leave."""
