"""What grids cost an agent and the link: CPU of a scan and of the frames it is spread over, bytes up and down."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.scans.local_grid import LocalGrid
from kiteline_bench.grid.scans import Scanner
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.run import fly_alone, fly_recording
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import GridTile, KeyframeScan, Record, messages
from kiteline_codec.schema.base.grid_tile import TILE_CELLS
from kiteline_core.arrays import I64

_ROUNDS = 3  # flights with and without scans, in turn
_WARM = 3  # scans before time is taken
_EVERY = 10  # frames between two scans
_P95 = 1.05  # of the frames without scans
_AGENT_MIB = 4.0


def run(bench: Bench) -> list[Bar]:
    """The recorded room."""
    recording = load(bench.source("room_flight.mcap"))
    return [*_scan_cpu(bench, recording), *_frames(bench, recording), *_bytes(bench, recording), _agent_memory()]


def _scan_cpu(bench: Bench, recording: Recording) -> list[Bar]:
    bench.say("scanning room_flight")
    scanner, taken = Scanner(recording.rig), []
    for item in recording.items[::_EVERY]:
        if item.frame.right is None or item.T_w_b is None:
            continue
        begin = time.process_time_ns()
        scanner.scan(item.frame, item.T_w_b)
        taken.append((time.process_time_ns() - begin) * 1e-6)
    return [at_most("a scan: CPU, rectification included, median", float(np.median(taken[_WARM:])), 10.0, "ms", 1)]


def _frames(bench: Bench, recording: Recording) -> list[Bar]:
    """CPU of a frame with scans over that without, in alternation."""
    on = AgentConfig()
    off = replace(on, scan=replace(on.scan, on=False))
    mean: dict[bool, list[float]] = {True: [], False: []}
    p95: dict[bool, list[float]] = {True: [], False: []}
    for k in range(_ROUNDS):
        for scans in (True, False):
            bench.say(f"flying room_flight {'with' if scans else 'without'} scans ({k + 1} of {_ROUNDS})")
            cpu = np.array(fly_alone(recording, on if scans else off).cpu_ns[40:]) * 1e-6
            mean[scans].append(float(cpu.mean()))
            p95[scans].append(float(np.quantile(cpu, 0.95)))
    bench.more.append(
        f"A frame without scans: {np.median(mean[False]):.2f} ms, p95 {np.median(p95[False]):.2f}; with scans "
        f"{np.median(mean[True]):.2f} ms, p95 {np.median(p95[True]):.2f}."
    )
    ratio = float(np.median(np.array(p95[True]) / np.array(p95[False])))
    return [at_most("p95 of a frame's CPU with scans, over that without", ratio, _P95, "", 3)]


class ReceivedBytes:
    """An end of a link that counts the codes of scans and tiles that arrive. It is the wrapped end in all else."""

    def __init__(self, channel: RecordChannel, scans: list[int], tiles: list[int]) -> None:
        self._channel = channel
        self._counts = ((KeyframeScan, scans), (GridTile, tiles))

    def __getattr__(self, name: str) -> object:
        return getattr(self._channel, name)

    def receive(self, packets: Sequence[bytes], now_ns: int) -> list[Record]:
        """Take in packets, and note the bytes of records that count."""
        records = self._channel.receive(packets, now_ns)
        for record in records:
            for kind, sizes in self._counts:
                if isinstance(record, kind):
                    sizes.append(len(messages.encode(record)))
        return records


def _bytes(bench: Bench, recording: Recording) -> list[Bar]:
    """Codes of scans and tiles that arrive in a flight with a base."""
    bench.say("flying room_flight with a base")
    scans: list[int] = []
    tiles: list[int] = []
    fly_recording(recording, channels=lambda channel: cast(RecordChannel, ReceivedBytes(channel, scans, tiles)))
    if not scans or not tiles:
        return [is_true("scans come up and tiles go down", "some of both", False, f"{len(scans)} and {len(tiles)}")]
    each = f"{len(scans)} scans of {np.mean(scans):.0f} bytes came up, {len(tiles)} tiles of {np.mean(tiles):.0f} down."
    bench.more.append(each)
    return [
        at_most("bytes of a scan that comes up, mean", float(np.mean(scans)), 200.0, "B", 0),
        at_most("bytes of tiles that go down, for each scan", sum(tiles) / len(scans), 150.0, "B", 0),
    ]


def _agent_memory() -> Bar:
    """The agent's grid at its largest."""
    config = AgentConfig().local_grid
    arrays = [v for v in vars(LocalGrid(config)).values() if isinstance(v, np.ndarray)]
    own: I64 = np.array([v.nbytes for v in arrays])
    mib = (int(own.sum()) + config.tiles * TILE_CELLS**2) / 2**20
    return at_most("the agent's grid: own cells and the most tiles that it keeps", mib, _AGENT_MIB, "MiB", 2)
