"""Poses, points and observations enter; the bundle-adjusted ones leave."""
