"""Tracks the local map in one frame: image pyramids and a predicted pose enter, a measured pose leaves."""
