"""CPU time of each frame enters; the effort to spend on the next frame leaves."""
