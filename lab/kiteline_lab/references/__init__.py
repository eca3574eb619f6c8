"""Kept logs enter and are replayed; what each stage computes leaves as text, and what differs from the kept text."""
