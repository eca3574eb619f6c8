"""Live cameras: captured images enter (encoded or raw, stamped by the driver), a LiveSource of paired Frames leaves."""
