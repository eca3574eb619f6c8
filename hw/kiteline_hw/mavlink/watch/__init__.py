"""Watches a flight controller: messages and times in, findings out. Pure."""
