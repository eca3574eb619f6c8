"""Samples of the IMU: which are usable, the newest of them and their noise, and whether they come at all."""
