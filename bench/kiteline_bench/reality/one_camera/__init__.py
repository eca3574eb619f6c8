"""Recordings of one camera and an IMU enter; when lengths are metres, and how right they are, leaves as bars."""
