"""Runs one agent in a process: command line, source, log, link and flight controller around its steps."""
