"""Types of command-line arguments that several programs take."""

import argparse


def limit(text: str) -> float:
    """A number, 0 for no limit. Raises ArgumentTypeError for a negative one, for "nan" and for other text."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not value >= 0.0:
        raise argparse.ArgumentTypeError(f"{text}: expected 0 (no limit) or more")
    return value


def count_limit(text: str) -> int:
    """A whole number, 0 for no limit. Raises ArgumentTypeError for a negative one, and for other text."""
    limit(text)
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text}: expected a whole number, 0 (no limit) or more") from None
