"""Tracks and dead-reckoned motion enter; pose covariances, consistency checks and quality leave."""
