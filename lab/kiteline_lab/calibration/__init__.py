"""Calibration of cameras by a board: images in; intrinsics, lens, extrinsics of a pair and a verdict out."""
