"""Descriptors of places enter; similar places leave."""
