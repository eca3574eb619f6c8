"""Checks of `kiteline doctor` beyond the installation: the computer on the vehicle, and its flight controller."""
