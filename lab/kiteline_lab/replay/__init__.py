"""Logs of agents and bases enter; the same steps are run again, and the first output that differs leaves."""
