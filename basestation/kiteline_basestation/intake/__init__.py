"""Intake of records: what agents wrote enters; keyframes in the map and placed submaps leave."""
