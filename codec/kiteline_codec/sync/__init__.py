"""State synchronisation: keeps the values of two sides in agreement over a lossy link.

In: keys and codes, packets, time. Out: packets, and the values of the peer that changed.
"""
