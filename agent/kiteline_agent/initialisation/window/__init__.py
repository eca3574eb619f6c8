"""Solves the window of a monocular start with an IMU: corners and samples enter, states in metres leave."""
