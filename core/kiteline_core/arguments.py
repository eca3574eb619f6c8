"""Types of command-line arguments that several programs take."""

from __future__ import annotations

import argparse


def limit(text: str) -> float:
    """A number, 0 for no limit. Raises ArgumentTypeError for a negative one, and for "nan"."""
    value = float(text)
    if not value >= 0.0:
        raise argparse.ArgumentTypeError(f"{text}: expected 0 (no limit) or more")
    return value


def count_limit(text: str) -> int:
    """A whole number, 0 for no limit. Raises ArgumentTypeError for a negative one."""
    limit(text)
    return int(text)
