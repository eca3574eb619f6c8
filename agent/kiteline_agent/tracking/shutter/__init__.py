"""The rolling shutter of a camera: what it does to pixels, and its read-out where no calibration says it."""
