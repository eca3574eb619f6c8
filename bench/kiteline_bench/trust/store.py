"""Flipped bits in the store of a flight: nothing altered is loaded without a word, and a base begins with the rest."""

import shutil
from pathlib import Path

import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.station import Station
from kiteline_basestation.store.checksums import StoreError
from kiteline_basestation.store.restore import restore
from kiteline_basestation.store.saved_map import SavedMap
from kiteline_basestation.store.store import FILE, read
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_codec.channel import CodedChannel
from kiteline_codec.schema import WireError
from kiteline_codec.sync.config import SyncConfig

_STORES, _FLIPS = 100, 100
_BEGUN_EVERY = 25  # copies of which one is restored, as a base that begins does


def run(bench: Bench) -> list[Bar]:
    """Flip one bit after the other in copies of the store of a short flight, and two to five at once in as many."""
    folder = bench.folder / "trust_store"
    shutil.rmtree(folder, ignore_errors=True)
    bench.fly(bench.source("room_flight.mcap"), "trust_store_flight", seconds=4.0, store=str(folder))
    saved, content = read(folder), (folder / FILE).read_bytes()
    random, copy = np.random.default_rng(1), bench.folder / "trust_store_copy"
    shutil.rmtree(copy, ignore_errors=True)
    copy.mkdir()
    found = {"as written": 0, "named": 0, "refused": 0, "altered": 0}
    n, tried, begun = bench.starts or _STORES, 0, 0
    for k in range(n * _FLIPS):
        damaged = bytearray(content)
        for _ in range(1 if k % 2 == 0 else int(random.integers(2, 6))):
            damaged[int(random.integers(len(damaged)))] ^= 1 << int(random.integers(8))
        (copy / FILE).write_bytes(damaged)
        outcome, left = _outcome(saved, copy / FILE)
        found[outcome] += 1
        if left is not None and k % _BEGUN_EVERY == 0:
            tried += 1
            begun += _begins(left)
        if k % 1000 == 999:
            bench.say(f"trust/store: {k + 1} of {n * _FLIPS}: {found}")
    bench.more.append(
        f"A store of {len(content) / 1e3:.0f} kB, {n * _FLIPS} copies with one to five flipped bits: "
        f"{found['as written']} read as written (the bits meant nothing), {found['named']} with what was left out "
        f"named, {found['refused']} refused."
    )
    return [
        at_most("flipped bits that were loaded without a word", found["altered"], 0, "", 0),
        is_true("bases that begin with what is left", "all", begun == tried > 0, f"{begun} of {tried}"),
    ]


def _begins(left: SavedMap) -> bool:
    """True if a base begins with what a damaged store has left."""
    try:
        restore(Station(BaseConfig(), lambda _: CodedChannel(SyncConfig(), 1)), left, 0)
    except WireError:
        return False
    return True


def _outcome(saved: SavedMap, file: Path) -> tuple[str, SavedMap | None]:
    """What became of a damaged store, and what could be read of it."""
    try:
        got = read(file)
    except StoreError:
        return "refused", None
    if (got.agents, got.texts) == (saved.agents, saved.texts):
        return "as written" if not got.faults else "named", got
    sound = all(
        saved.agents.get(agent) is not None and all(ours.get(key) == code for key, code in theirs.items())
        for agent, codes in got.agents.items()
        for ours, theirs in (
            (saved.agents[agent].received if agent in saved.agents else {}, codes.received),
            (saved.agents[agent].own if agent in saved.agents else {}, codes.own),
        )
    ) and all(saved.texts.get(name) == text for name, text in got.texts.items())
    return "named" if sound and got.faults else "altered", got
