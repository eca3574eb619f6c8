"""In: keyframe poses of maps, and what the agents know by their IMUs. Out: how long a metre is, and what is level."""
