"""Right cameras that were bent against their calibration, before the flight or in it; and pairs of no rig at all."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from kiteline_bench.harness.bars import Bar, Bench, at_most, table
from kiteline_bench.harness.recording import Recording, load
from kiteline_bench.harness.result import AgentRun
from kiteline_bench.harness.run import fly_alone
from kiteline_core.frame import Frame
from kiteline_core.geometry import se3

_ROOM, _SECONDS, _STARTS_S = "room_flight.mcap", 8.0, (0.0, 6.0, 12.0)
_STREET = "kitti_straight"
_LIMIT_M = 0.1
_BENT_AT_S = 4.0  # into the flight
_STREET_ROWS = (2, 6, -9)

Change = Callable[[Recording], Recording]


def run(bench: Bench) -> list[Bar]:
    """Errors and frames without a pose of a room and a street by bent rigs; what is said of unlike pairs."""
    room = load(bench.source(_ROOM))
    rows: list[tuple[object, ...]] = []
    errors_m, lost = [], 0
    for start_s in bench.chosen(_STARTS_S):
        part = room.seconds(start_s, start_s + _SECONDS)
        for imu in (True, False):
            true = part if imu else part.without_imu()
            for what, bent in _BENT.items():
                flight = fly_alone(bent(true))
                errors_m.append(flight.ate_m("o"))
                lost += flight.lost
                rows.append((what, "yes" if imu else "no", start_s, 1000.0 * errors_m[-1], flight.lost))
                bench.say(f"{what}, {'with' if imu else 'without'} the IMU, from {start_s:g} s: {errors_m[-1]:.4f} m")
    table(bench, f"{_ROOM}, the agent alone", ("bent", "IMU", "start s", "ATE mm", "frames without a pose"), rows)
    return [
        at_most(f"bent rigs, {_ROOM}: ATE, worst of {len(errors_m)}", float(np.max(errors_m)), _LIMIT_M, "m"),
        at_most(f"bent rigs, {_ROOM}: frames without a pose", lost, 0, "", 0),
        *_street(bench),
        *_unlike(room.seconds(0.0, 2.0)),
    ]


def _street(bench: Bench) -> list[Bar]:
    """A real street whose right images are some rows lower."""
    street = load(bench.source(_STREET))
    flights = {rows: fly_alone(_lower(street, rows, 0.0)) for rows in (0, *_STREET_ROWS)}
    table(bench, f"{_STREET}, the agent alone", ("right images lower by", "ATE mm", "frames without a pose"),
          [(rows, 1000.0 * f.ate_m("o"), f.lost) for rows, f in flights.items()])  # fmt: skip
    return [at_most(f"bent rigs, {_STREET}: frames without a pose", sum(f.lost for f in flights.values()), 0, "", 0)]


def _unlike(part: Recording) -> list[Bar]:
    """Pairs with which no map may begin: each has to be named."""
    flights = [fly_alone(change(part)) for change in _UNLIKE]
    return [
        at_most("unlike pairs: frames with a pose", sum(len(f.tracked) for f in flights), 0, "", 0),
        at_most("unlike pairs: flights of which nothing is said", sum(not _named(f) for f in flights), 0, "", 0),
    ]


def _named(flight: AgentRun) -> bool:
    return bool(flight.frames_with_event("images:"))


def _turned(pitch: float, yaw: float, roll: float) -> Change:
    """The right camera turned by degrees."""

    def change(recording: Recording) -> Recording:
        T_c_r = recording.rig.T_c_r
        assert T_c_r is not None
        turn = se3.from_rt(se3.so3_exp(np.radians([pitch, yaw, roll])), np.zeros(3))
        return replace(recording, rig=replace(recording.rig, T_c_r=T_c_r @ turn))

    return change


def _with_frames(recording: Recording, change: Callable[[int, Frame], Frame]) -> Recording:
    items = (replace(item, frame=change(k, item.frame)) for k, item in enumerate(recording.items))
    return replace(recording, items=tuple(items))


def _lower(recording: Recording, rows: int, from_s: float) -> Recording:
    """Right images lower by some rows, from a time on."""
    begin_ns = recording.items[0].frame.t_ns + round(from_s * 1e9)

    def change(_: int, frame: Frame) -> Frame:
        assert frame.right is not None
        return frame if frame.t_ns < begin_ns else replace(frame, right=np.roll(frame.right, rows, axis=0))

    return _with_frames(recording, change)


def _upside_down(_: int, frame: Frame) -> Frame:
    assert frame.right is not None
    return replace(frame, right=np.ascontiguousarray(frame.right[::-1, ::-1]))


def _exchanged(_: int, frame: Frame) -> Frame:
    assert frame.right is not None
    return replace(frame, left=frame.right, right=frame.left)


def _dark(_: int, frame: Frame) -> Frame:
    assert frame.right is not None
    return replace(frame, left=frame.left // 64, right=frame.right // 64)


_BENT: Mapping[str, Change] = {
    "pitch 0.25 degrees": _turned(0.25, 0.0, 0.0),
    "pitch 0.6 degrees": _turned(0.6, 0.0, 0.0),
    "pitch -1.2 degrees": _turned(-1.2, 0.0, 0.0),
    "yaw 0.6 degrees": _turned(0.0, 0.6, 0.0),
    "yaw -0.6 degrees": _turned(0.0, -0.6, 0.0),
    "roll 0.5 degrees": _turned(0.0, 0.0, 0.5),
    "all axes": _turned(0.3, 0.3, 0.3),
    f"6 rows, from {_BENT_AT_S:g} s on": lambda recording: _lower(recording, 6, _BENT_AT_S),
}
_UNLIKE: tuple[Change, ...] = (
    lambda recording: _with_frames(recording, _exchanged),
    lambda recording: _with_frames(recording, _upside_down),
    lambda recording: _with_frames(recording, _dark),
)
