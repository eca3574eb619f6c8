"""The visual vocabulary that ships with kiteline."""

from importlib.resources import files

from kiteline_core.places.place_index import Vocabulary, unpack


def shipped_vocabulary() -> Vocabulary:
    """The vocabulary tree for place recognition, from the package's data."""
    return unpack(files("kiteline_core.places").joinpath("words.bin").read_bytes())
