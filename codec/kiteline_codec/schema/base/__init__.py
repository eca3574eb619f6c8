"""Records that the base writes: one module each, kinds 16 to 62."""
