"""Flights in several maps: recordings cut for several robots enter; merges, joint errors and a plot leave."""
