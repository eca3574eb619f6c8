"""Names of image files: in which order the images were taken, and which of two cameras' images are a pair."""

import re
from collections.abc import Hashable, Iterator, Sequence
from itertools import zip_longest
from pathlib import Path

_NUMBER = re.compile(r"([0-9]+)")
_LEAST_PAIRED = 0.5  # of the side with fewer images: if fewer share a number, the numbers mean something else

Keys = Sequence[Hashable]


def in_natural_order(paths: list[Path]) -> list[Path]:
    """Paths sorted by name, numbers in the names by their value: 2.png comes before 10.png."""
    return sorted(sorted(paths), key=lambda path: [_pieces(part) for part in path.parts])


def _pieces(name: str) -> list[str | int]:
    """Text and numbers of a name by turns, text first, so that the pieces of two names can be compared."""
    return [int(piece) if k % 2 else piece for k, piece in enumerate(_NUMBER.split(name))]


def pair_keys(lefts: list[Path], rights: list[Path]) -> tuple[Keys, Keys] | None:
    """A key for each left and each right image, equal for the two of a pair; None if the names do not tell.

    Keys are the numbers in the path that vary within a side (`cam0` and `left2` do not), one of these numbers, or the
    whole name: the first of them that is unique on each side and that both sides share.
    """
    return next((keys for keys in _candidates(lefts, rights) if _fit(*keys)), None)


def _candidates(lefts: list[Path], rights: list[Path]) -> Iterator[tuple[Keys, Keys]]:
    sides = [[_numbers(path) for path in paths] for paths in (lefts, rights)]
    varying = [_varying(side) for side in sides]
    if len(varying[0]) != len(varying[1]):  # a side with few images need not show all that varies
        varying = [sorted({*varying[0], *varying[1]})] * 2
    chosen = [(varying[0], varying[1]), *(([left], [right]) for left, right in zip(*varying, strict=True))]
    for left, right in chosen:
        yield _chosen(sides[0], left), _chosen(sides[1], right)
    yield [path.stem for path in lefts], [path.stem for path in rights]


def _numbers(path: Path) -> list[int]:
    """The numbers in a path without its suffix, the last one first: folders may differ in how many they hold."""
    return [int(number) for number in _NUMBER.findall(str(path.with_suffix("")))][::-1]


def _varying(side: list[list[int]]) -> list[int]:
    return [k for k, column in enumerate(zip_longest(*side)) if len(set(column)) > 1]


def _chosen(side: list[list[int]], places: list[int]) -> Keys:
    return [tuple(numbers[k] if k < len(numbers) else None for k in places) for numbers in side]


def _fit(lefts: Keys, rights: Keys) -> bool:
    """True if keys are unique on each side, and enough are shared."""
    left, right = set(lefts), set(rights)
    unique = len(left) == len(lefts) and len(right) == len(rights)
    return unique and len(left & right) >= _LEAST_PAIRED * min(len(left), len(right))
