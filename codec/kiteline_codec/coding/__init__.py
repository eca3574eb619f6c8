"""Numbers, quantised arrays and columns of integers to bytes and back.

In: numpy arrays. Out: bytes; and the reverse, which raises only WireError.
"""
