"""Calibration of the IMU in flight: poses by images and raw samples enter, corrections of the samples leave."""
