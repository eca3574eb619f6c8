"""Logs: flown for hours, cut anywhere, replayed; bars leave."""
