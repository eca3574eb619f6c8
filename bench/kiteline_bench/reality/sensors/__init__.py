"""Recordings whose sensors are bad, wrong, late or silent enter; what that costs leaves as bars."""
