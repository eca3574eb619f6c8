"""The base class of every error that a user can mend."""

import struct


class KitelineError(Exception):
    """An error outside of the program. Its text says what was found, what was expected and how to mend it.

    Each room derives its own from this class; the command line prints them as one line, without a traceback.
    """


# What Python and its libraries raise on input that is too deep, too large or cut; a reader of bytes from outside turns
# these into its room's error.
INPUT_FAULTS = (RecursionError, OverflowError, MemoryError, struct.error)
