"""Packets through a flight controller's telemetry radio: packets enter and leave as TUNNEL messages at both ends."""
