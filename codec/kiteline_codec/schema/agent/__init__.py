"""Records that the agent writes: one module each, kinds 1 to 15."""
