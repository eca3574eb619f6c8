"""Set up a machine."""
