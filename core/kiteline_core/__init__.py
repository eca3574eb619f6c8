"""The shared vocabulary and computation of kiteline: no I/O, no clock, no thread, no randomness of its own."""
