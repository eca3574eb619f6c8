"""The words that ship with kiteline."""

from __future__ import annotations

from importlib.resources import files

from kiteline_core.places.place_index import Vocabulary, unpack


def shipped_words() -> Vocabulary:
    """The tree of words by which places are recognised, as it lies in the package."""
    return unpack(files("kiteline_core.places").joinpath("words.bin").read_bytes())
