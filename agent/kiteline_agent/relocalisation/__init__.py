"""Finds the camera in stored keyframes, its own or cached ones of the base: a frame enters, a checked pose leaves."""
