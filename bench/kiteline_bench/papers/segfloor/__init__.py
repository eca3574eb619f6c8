"""Segfloor's corridors and its table: worlds like its own enter; road maps, memory and time of an update leave."""
