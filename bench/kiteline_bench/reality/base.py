"""The base beside the tracker alone: on every recording, with and without IMU, over both links."""

from collections.abc import Callable, Mapping

from kiteline_bench.harness.bars import Bar, Bench, table
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.reality import worn
from kiteline_bench.reality.flown import flown, spread
from kiteline_lab.evaluation.metrics import TrajectoryAlignment

Row = tuple[str, str, float, float, float, float]  # a line of COLUMNS

COLUMNS = ("flight", "link", "start s", "tracker alone", "live", "base")
_RATIO, _WORST_RATIO = 1.0, 1.1
_LINKS = {"wifi": (0, 0), "radio": (1000, 500)}  # bytes a second up and down; 0: no limit
_SCENES = ("room", "hall")


def run(bench: Bench) -> list[Bar]:
    """Ratios of live and refined ATE to the ATE without a base."""
    bars, rows = list[Bar](), list[Row]()
    for name, open_recording, starts_s in _flights(bench):
        recording = open_recording()
        for imu in (True, False) if recording.imu is not None and recording.rig.right is not None else (True,):
            flight = recording if imu else recording.without_imu()
            parts = {start_s: flight.seconds(start_s, 1e9) for start_s in bench.chosen(starts_s)}
            compared = beside_alone(bench, f"{name}{'' if imu else ', no IMU'}", parts)
            bars, rows = bars + compared[0], rows + compared[1]
    table(bench, "ATE in mm", COLUMNS, rows)
    return bars


def beside_alone(
    bench: Bench, what: str, parts: Mapping[float, Recording], alignment: TrajectoryAlignment = TrajectoryAlignment.SE3
) -> tuple[list[Bar], list[Row]]:
    """Bars and rows of a flight with a base, over each link, beside the same without. parts: of it, by start in s."""
    alone_m = {
        start_s: flown(bench, f"{what} from {start_s:g} s, no base", part, base=False).ate_m("live", 0.0, alignment)
        for start_s, part in parts.items()
    }
    bars, rows = list[Bar](), list[Row]()
    for link, bytes_s in _LINKS.items():
        found = []
        for start_s, part in parts.items():
            joined = flown(bench, f"{what} from {start_s:g} s, over {link}", part, bytes_s=bytes_s, profile=link)
            a, b, c = alone_m[start_s], *(joined.ate_m(path, 0.0, alignment) for path in ("live", "base"))
            bench.say(f"  ATE alone {a:.4f}, live {b:.4f}, base {c:.4f} m")
            rows.append((what, link, start_s, 1000.0 * a, 1000.0 * b, 1000.0 * c))
            found.append((b / a, c / a))
        for k, path in enumerate(("live", "base")):
            bars += spread(f"{what}, {link}: ATE {path} over that of the tracker alone",
                           [ratios[k] for ratios in found], _RATIO, "", 2, worst=_WORST_RATIO)  # fmt: skip
    return bars, rows


def _flights(bench: Bench) -> list[tuple[str, Callable[[], Recording], tuple[float, ...]]]:
    """Name, loader and starts in s."""
    room, street = (0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0), (0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2)
    real = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0)
    simulated = [
        (f"{rig} {scene}", lambda scene=scene, rig=rig: worn.recording(bench, scene, worn.SEEDS[0], rig), room)
        for scene in _SCENES
        for rig in ("true", "worn")
    ]
    return [
        ("kitti_straight", lambda: load(bench.source("kitti_straight")), street),
        ("room_flight", lambda: load(bench.source("room_flight.mcap")), room),
        ("euroc_mh01_air", lambda: load(bench.source("euroc_mh01_air"), mono=True), real),
        *simulated,
    ]  # fmt: skip
