"""Takes over what the base sends: records enter, corrected keyframes, cached keyframes and submap placements leave."""
