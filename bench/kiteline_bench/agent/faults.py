"""The agent's bars under faults and forced losses: no exception, a pose again soon, no wrong merge."""

from collections.abc import Sequence
from pathlib import Path

from kiteline_bench.harness import faults
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.run import fly_alone
from kiteline_core.geometry import tum

_JUMP_M = 0.35  # of the odometry in a frame's time: 7 m/s at 20 Hz
_FRAMES = 360  # 18 s, of which 10 without texture
_SOON = 3  # frames after texture returned


def fault_bars(bench: Bench, depth: Path) -> list[Bar]:
    """Every fault with stereo and IMU, monocular, and with a depth camera. depth: a recording of one."""
    room = bench.source("room_flight.mcap")
    bars = []
    for what, recording in (
        ("stereo and IMU", load(room, frames=_FRAMES)),
        ("monocular", load(room, frames=_FRAMES, imu=False, mono=True)),
        ("depth camera", load(str(depth), frames=_FRAMES, imu=False)),
    ):
        for name, fault in faults.camera_faults_of(recording).items():
            bench.say(f"flying with a fault: {name} ({what})")
            bars.append(_fault_bar(recording, fault, f"fault, {name} ({what})"))
    return bars


def _fault_bar(recording: Recording, fault: faults.Fault, name: str) -> Bar:
    try:
        run = fly_alone(fault(recording))
    except Exception as error:  # the bar is that there is none
        return is_true(name, "no exception", False, repr(error)[:100])
    jump, tracked = run.largest_jump_m(recording.period_ns), run.found[-1].tracked
    return is_true(name, f"tracked at the end, odometry moves < {_JUMP_M:g} m a frame", tracked and jump < _JUMP_M,
                   f"{'tracked' if tracked else 'lost'}, {run.lost_after_start} frames without a pose, "
                   f"{len({e.submap for e in run.found})} submaps, jump {jump:.3f} m")  # fmt: skip


def loss_bars(bench: Bench) -> list[Bar]:
    """A blank wall and out at another place; 2 s of black. With a base, as processes over a link."""
    with_imu = load(bench.source("room_flight.mcap"), frames=440)
    plain = with_imu.without_imu()
    wall = [None] * 40  # long enough to come to another place, so that odometry alone cannot tell where
    there = faults.rearranged(plain, [*range(100), *wall, *range(250, 440)])
    back = faults.rearranged(plain, [*range(100), *wall, *range(250, 330), *wall, *range(60, 140)])
    black, black_imu = (faults.changed(recording, 200, 240, faults.black) for recording in (plain, with_imu))
    return [
        *_loss(bench, "wall", "out of the wall at another place", there, [(100, 140)], (2, 2)),
        *_loss(bench, "wall_back", "out at another place, then back", back, [(100, 140), (220, 260)], (2, 3)),
        *_loss(bench, "black", "2 s of black", black, [(200, 240)], (1, 2)),
        *_loss(bench, "black_imu", "2 s of black, IMU", black_imu, [(200, 240)], (1, 2)),
    ]


def _loss(
    bench: Bench,
    folder: str,
    name: str,
    recording: Recording,
    holes: Sequence[tuple[int, int]],
    submaps: tuple[int, int],
) -> list[Bar]:
    """holes: frames that show nothing. submaps: fewest and most that are to be expected."""
    out = bench.folder / f"loss_{folder}"
    out.mkdir(parents=True, exist_ok=True)
    flown = bench.fly(recording.save(out / "flight.mcap"), out.name, imu=recording.imu is not None)
    agent = flown.agent()
    stamps = {line.split()[0] for line in (out / "agent0" / "live.tum").read_text().splitlines()}
    posed = [tum.stamp(item.frame.t_ns) in stamps for item in recording.items]
    late = max(next((k for k, good in enumerate(posed[end:]) if good), len(posed)) for _, end in holes)
    lost_later = sum(not good for k, good in enumerate(posed) if not any(a <= k < b + _SOON for a, b in holes))
    low, high = submaps
    return [
        at_most(f"loss, {name}: frames from texture to a pose", late + 1, _SOON, "", 0),
        at_most(f"loss, {name}: lost elsewhere", lost_later, 0, "", 0),
        is_true(f"loss, {name}: submaps", f"{low}" if low == high else f"{low} to {high}",
                low <= agent["submaps"] <= high, f"{agent['submaps']}, {flown.base['merges']} merged"),
        at_most(f"loss, {name}: ATE base of what is placed (no wrong merge)", flown.ate_m(), 0.05, "m", 4),
    ]  # fmt: skip
