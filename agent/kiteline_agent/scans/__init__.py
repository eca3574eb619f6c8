"""Column scans: images of a keyframe in, what stands around the vehicle out, for the base and the vehicle itself."""
