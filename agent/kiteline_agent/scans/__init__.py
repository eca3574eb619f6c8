"""Column scans: images enter; what stands around the vehicle leaves, for the base and the flight controller."""
