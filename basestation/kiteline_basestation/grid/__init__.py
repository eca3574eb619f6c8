"""The occupancy grid: placed keyframes and landmarks enter; labelled landmarks, tiles and map_server files leave."""
