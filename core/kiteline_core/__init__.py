"""Types and algorithms that both halves use; no I/O, clock, thread or randomness of its own."""
