"""Descriptors of two views enter; matches leave."""
