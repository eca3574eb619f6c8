"""Types of command-line arguments that several programs take."""

import argparse

_MOST_S = 1e6  # s, which nanoseconds hold by far


def limit(text: str) -> float:
    """A number, 0 for no limit. Raises ArgumentTypeError for a negative one, "nan" and "inf", and for other text."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text[:40]}: expected 0 (no limit) or more")
    return value


def count_limit(text: str) -> int:
    """A whole number, 0 for no limit. Raises ArgumentTypeError for a negative one, and for other text."""
    limit(text)
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: expected a whole number, 0 (no limit) or more") from None


def period(text: str) -> float:
    """Seconds, 0 or more. Raises ArgumentTypeError for other numbers, "nan" and "inf", and for other text."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= _MOST_S:
        raise argparse.ArgumentTypeError(f"{text[:40]}: expected seconds from 0 to {_MOST_S:g}")
    return value


def duration(text: str) -> float:
    """Seconds, more than 0. Raises ArgumentTypeError for other numbers, "nan" and "inf", and for other text."""
    value = period(text)
    if value == 0.0:
        raise argparse.ArgumentTypeError(f"{text[:40]}: expected more than 0 seconds")
    return value
