"""Calibrations and transforms enter; rectified images, poses and triangulated points leave."""
