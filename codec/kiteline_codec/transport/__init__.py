"""Packets, seals and frames of a byte stream.

In: header and items. Out: bytes to send; and the reverse.
"""
