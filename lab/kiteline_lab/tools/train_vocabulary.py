"""`python -m kiteline_lab.tools.train_vocabulary SOURCE… --out FILE`: train the visual vocabulary of the place index.

The vocabulary that ships with kiteline is trained on its own simulated scenes (no licence of a data set applies):

    python -m kiteline_lab.tools.train_vocabulary --out core/kiteline_core/places/words.bin
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from kiteline_agent.imaging import features
from kiteline_core.arrays import I64, U8, U64
from kiteline_core.frame import Frame
from kiteline_core.geometry.cameras import Rectifier
from kiteline_core.imaging.matching import words
from kiteline_core.places.place_index import Vocabulary, nodes, pack
from kiteline_hw.ports import FrameSource, SourceError
from kiteline_hw.sim.source import SimSource
from kiteline_hw.sources.open import open_source
from kiteline_lab.tools import train_vocabulary_kernels as kernels

SCENES = ("room", "hall", "street", "corridor")
DEFAULT_SOURCES = tuple(f"sim:{scene}?seed={seed}&mono=1" for seed in range(101, 105) for scene in SCENES)
_ROUNDS = 12  # k-majority iterations; clusters hardly move after eight


def main(argv: list[str] | None = None) -> int:
    """Run the command. Raises SourceError."""
    p = argparse.ArgumentParser(
        prog="python -m kiteline_lab.tools.train_vocabulary", description="Train the vocabulary of the place index."
    )
    p.add_argument(
        "sources", nargs="*", metavar="SOURCE", default=list(DEFAULT_SOURCES), help="default: simulated scenes"
    )
    p.add_argument("--out", type=Path, required=True, metavar="FILE")
    p.add_argument("--every", type=int, default=24, metavar="N", help="take each N-th frame (default 24)")
    p.add_argument("--branching", type=int, default=10, metavar="K")
    p.add_argument("--levels", type=int, default=4, metavar="L")
    p.add_argument("--seed", type=int, default=1)
    o = p.parse_args(argv)
    images: list[U8] = []
    for spec in o.sources:
        source = open_source(spec, mono=True, imu=False)
        try:
            images.extend(descriptors(source, o.every))
        finally:
            source.close()
        print(f"{spec}: {sum(map(len, images))} descriptors of {len(images)} images so far", file=sys.stderr)
    vocabulary = train(images, o.branching, o.levels, o.seed)
    o.out.write_bytes(pack(vocabulary))
    print(f"{o.out}: {len(vocabulary.weight)} words, {o.out.stat().st_size} bytes")
    return 0


def descriptors(source: FrameSource, every: int) -> Iterator[U8]:
    """ORB descriptors (n,32) of every N-th frame of a source."""
    rectifier = Rectifier(source.rig)
    config = features.DetectorConfig(max_corners=600, cell_px=20)
    for frame in _frames(source, every):
        pyramid = features.build_pyramid(rectifier.left(frame.left), config.levels)
        corners = features.detect(pyramid, np.zeros((0, 2)), config)
        yield features.describe(pyramid, corners.uv, corners.octave)[1]


def _frames(source: FrameSource, every: int) -> Iterator[Frame]:
    if isinstance(source, SimSource):  # renders only the frames that are used
        cameras = source.cameras()
        for k in range(0, source.frame_count or 0, every):
            yield source.render(k, cameras)
        return
    number = 0
    for item in source:
        if isinstance(item, Frame):
            if number % every == 0:
                yield item
            number += 1


def train(images: list[U8], branching: int, levels: int, seed: int) -> Vocabulary:
    """Train a vocabulary tree by hierarchical k-majority; weights are log(images / images that have the word).

    images: descriptors (n,32) of each image. Raises SourceError if there are fewer descriptors than words.
    """
    descriptor = words(np.concatenate(images)) if images else np.zeros((0, 4), np.uint64)
    if len(descriptor) < branching**levels:
        raise SourceError(
            f"{len(descriptor)} descriptors are too few for {branching}^{levels} words: give more sources or frames"
        )
    rng = np.random.default_rng(seed)
    centres = np.zeros((nodes(branching, levels), 4), np.uint64)
    groups: list[I64] = [np.arange(len(descriptor))]
    base = 0
    for _ in range(levels):
        below: list[I64] = []
        for g, member in enumerate(groups):
            at = base + g * branching
            below.extend(_split(descriptor, member, centres[at : at + branching], rng))
        base += branching * len(groups)
        groups = below
    bare = Vocabulary(branching, levels, centres, np.ones(branching**levels, np.float32))
    having = np.zeros(branching**levels)
    for image in images:
        having[np.unique(bare.words_of(image))] += 1.0
    weight = np.log(
        (len(images) + 1.0) / np.maximum(having, 1.0)
    )  # a word that no image has weighs as much as one in a single image
    return Vocabulary(branching, levels, centres, weight.astype(np.float32))


def _split(descriptor: U64, member: I64, centre: U64, rng: np.random.Generator) -> list[I64]:
    """Cluster `member` rows into k groups; writes their centres (k,4). Returns the rows of each group."""
    if len(member) == 0:
        return [member] * len(centre)
    kernels.spread_centres(descriptor, member, int(rng.integers(len(member))), centre)
    label = np.full(len(member), -1, np.int32)
    for _ in range(_ROUNDS):
        if kernels.assign_to_nearest(descriptor, member, centre, label) == 0:
            break
        kernels.update_centres(descriptor, member, label, centre)
    kernels.assign_to_nearest(descriptor, member, centre, label)
    return [member[label == c] for c in range(len(centre))]


if __name__ == "__main__":
    raise SystemExit(main())
