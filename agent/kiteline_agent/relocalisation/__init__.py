"""Finds the camera in remembered keyframes, its own or cached ones of the base: a frame enters, a checked pose leaves."""
