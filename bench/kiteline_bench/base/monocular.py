"""The bars of monocular maps without IMU: loops correct the drift of scale, merges give the map its metre."""

from collections.abc import Sequence
from pathlib import Path

from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_bench.harness.placed import KeyframesInWorld
from kiteline_bench.harness.result import FlownProcesses
from kiteline_bench.harness.run import Part, Scenario, fly_with_base

_SECONDS = 60.0  # of the flights in the hall: in which both see the same walls
_BEGIN = (Part(0.0, _SECONDS),)


def bars(bench: Bench, street: FlownProcesses, hall: Sequence[Path]) -> list[Bar]:
    """street: KITTI 06, flown monocular. hall: recordings of MH_01 and MH_03 in one hall."""
    base_m, odometry_m = (street.ate_m(trajectory) for trajectory in ("base", "odometry"))
    stereo = Scenario(f"mcap:{hall[0]}", 0, parts=_BEGIN)
    first, second = (Scenario(f"mcap:{path}", agent, parts=_BEGIN, mono=True) for agent, path in enumerate(hall))
    bench.say("flying MH_01 with stereo and MH_03 monocular")
    mixed = KeyframesInWorld(fly_with_base([stereo, second]))
    bench.say("flying both monocular")
    single = KeyframesInWorld(fly_with_base([first, second]))
    return [
        is_true("KITTI 06 in the street, monocular: loop", "closed", street.base["loops"] >= 1,
                f"{street.base['loops']} loops"),
        at_most("KITTI 06 in the street, monocular: ATE base, scale aligned", base_m, 1.0, "m"),
        at_most("the same over that of the agent's odometry", base_m / odometry_m, 0.5, "", 2),
        is_true(f"monocular MH_03 beside stereo MH_01, {_SECONDS:g} s", "one map", mixed.merges == 1,
                f"{mixed.merges} merges"),
        at_most("its ATE, scale as it is", mixed.ate_m([1], with_scale=False), 0.02, "m", 4),
        at_most("how far its metre is off", 100.0 * mixed.length_error(1), 1.0, "%", 2),
        at_most("joint ATE of both, scale as it is", mixed.ate_m([0, 1], with_scale=False), 0.025, "m", 4),
        is_true("MH_01 and MH_03, both monocular", "one map", single.merges == 1, f"{single.merges} merges"),
        at_most("their joint ATE, one scale for both aligned", single.ate_m([0, 1], with_scale=True), 0.025, "m", 4),
    ]  # fmt: skip
