"""Calibration files of kiteline and of other tools, read and written; what a file says is a `FileCalibration`."""
