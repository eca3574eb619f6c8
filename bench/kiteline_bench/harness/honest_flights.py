"""Simulated flights along random and recorded paths, with faults in their middle, and how a pose errs on them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kiteline_agent.agent import Agent
from kiteline_agent.config import AgentConfig
from kiteline_agent.exchange.no_base import NoBaseChannel
from kiteline_agent.runtime.frame_reader import joined
from kiteline_agent.step import Estimate, Identity, StepInput
from kiteline_core.frame import Frame, ImuBatch, ImuCalibration
from kiteline_core.geometry import se3, tum
from kiteline_core.geometry.cameras import CameraRig
from kiteline_core.ids import AgentId
from kiteline_core.places.place_index import Vocabulary
from kiteline_hw.sim.sensors.lens import make_rig
from kiteline_hw.sim.source import open_sim

F64 = NDArray[np.float64]

_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # a level camera that looks along x
_RECORDED = (("V1_02_medium", "room"), ("MH_03_medium", "hall"), ("MH_01_easy", "hall"))


@dataclass(frozen=True, slots=True)
class Shown:
    """What an agent gets in one step, and where the body then is, T_w_b (4,4)."""

    frame: Frame
    imu: ImuBatch | None
    truth: F64


@dataclass(frozen=True, slots=True)
class HonestFlight:
    """A flight in memory. moving: it begins in full motion."""

    rig: CameraRig
    imu: ImuCalibration
    items: tuple[Shown, ...]
    moving: bool


def flight(number: int, trajectories: Path, scratch: Path, scale: float = 1.0, seconds: float = 0.0) -> HonestFlight:
    """Flight `number`: 9 to 13 s of a recorded path, or of a random smooth one, in a world and with a lens and noise of
    its own. scale: of the images. seconds: another length.
    """
    rng = np.random.default_rng([number, 77])
    drawn = float(rng.uniform(9.0, 13.0))
    seconds = seconds or drawn
    options: dict[str, Any] = {
        "seed": 1000 + number, "seconds": seconds, "scale": scale,
        "lens": ("radtan", "radtan", "equidistant")[int(rng.integers(3))],
        "read_noise": float(rng.uniform(0.8, 2.5)), "shot_noise": float(rng.uniform(0.01, 0.04)),
        "rest": float(rng.choice([0.0, 1.0, 1.0])),
    }  # fmt: skip
    if number % 3 == 0:
        name, scene = _RECORDED[number // 3 % 3]
        file = trajectories / f"{name}.txt"
        stamps = np.loadtxt(file, usecols=0)
        start_s = float(rng.uniform(5.0, stamps[-1] - stamps[0] - seconds - 5.0))
        options |= {"trajectory": str(file), "start": start_s}
    elif number % 6 == 5:
        scene = "corridor"
        options["start"] = float(rng.uniform(0.0, 50.0))
    else:
        scene = "room" if number % 3 == 1 else "hall"
        path = scratch / f"path{number}.txt"
        _write_path(path, rng, seconds, (1.6, 1.8, 0.4) if scene == "room" else (4.0, 4.0, 0.8))
        options["trajectory"] = str(path)
    source = open_sim(scene, **options)
    assert source.imu is not None and source.ground_truth is not None
    items: list[Shown] = []
    pending: ImuBatch | None = None
    for item in source:
        if isinstance(item, ImuBatch):
            pending = item
            continue
        if not isinstance(item, Frame):
            continue
        items.append(Shown(item, pending, source.ground_truth.T_w_b[len(items)]))
        pending = None
    return HonestFlight(source.rig, source.imu, tuple(items), options["rest"] == 0.0)


def _write_path(file: Path, rng: np.random.Generator, seconds: float, size_m: tuple[float, float, float]) -> None:
    """A smooth path as a TUM file: sums of slow waves, the head turning to and fro."""
    t = np.arange(0.0, seconds + 3.0, 0.05)
    p = np.tile([0.0, 0.0, 1.4], (len(t), 1))
    for axis, size in enumerate(size_m):
        for _ in range(3):
            wave = np.sin(2 * np.pi * t / rng.uniform(6.0, 16.0) + rng.uniform(0.0, 2 * np.pi))
            p[:, axis] += size * rng.uniform(0.3, 1.0) / 1.5 * wave
    yaw = rng.uniform(0.0, 2 * np.pi) + rng.uniform(-0.25, 0.25) * t
    for _ in range(2):
        yaw = yaw + rng.uniform(0.2, 0.7) * np.sin(2 * np.pi * t / rng.uniform(4.0, 12.0) + rng.uniform(0.0, 2 * np.pi))
    roll, pitch = (0.08 * np.sin(2 * np.pi * t / rng.uniform(2.0, 5.0)) for _ in "rp")
    T_c_b = se3.inverse(make_rig().T_b_c)
    lines = []
    for i in range(len(t)):
        r = se3.so3_exp(np.array([0.0, 0.0, yaw[i]])) @ se3.so3_exp(np.array([roll[i], 0.06 + pitch[i], 0.0])) @ _AHEAD
        lines.append(tum.line(round(t[i] * 1e9), se3.from_rt(r, p[i]) @ T_c_b))
    file.write_text("".join(lines))


# faults


def _each(change: Callable[[Frame], Frame], first: int, count: int) -> Callable[[list[Shown]], list[Shown]]:
    def apply(items: list[Shown]) -> list[Shown]:
        n = len(items) // 2 + first
        inside = items[n : n + count]
        return [*items[:n], *(replace(s, frame=change(s.frame)) for s in inside), *items[n + len(inside) :]]

    return apply


def _grey(level: float) -> Callable[[Frame], Frame]:
    def change(frame: Frame) -> Frame:
        rng = np.random.default_rng([frame.t_ns, 5])
        images = [
            np.clip(level + 1.5 * rng.standard_normal(frame.left.shape), 0, 255).astype(np.uint8) for _ in range(2)
        ]
        return replace(frame, left=images[0], right=images[1])

    return change


def _gain(factor: float, offset: float = 0.0) -> Callable[[Frame], Frame]:
    def bent(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.asarray(np.clip(image * factor + offset, 0, 255), np.uint8)

    return lambda frame: replace(
        frame, left=bent(frame.left), right=None if frame.right is None else bent(frame.right)
    )  # fmt: skip


def _frozen(items: list[Shown]) -> list[Shown]:
    last = items[len(items) // 2 - 1].frame
    return _each(lambda f: replace(f, left=last.left, right=last.right), 0, 12)(items)


def _fast(items: list[Shown]) -> list[Shown]:
    """Every fourth frame for a while: turns and motions between frames are four times as large."""
    n = len(items) // 2
    out = items[:n]
    for k in range(n, n + 32, 4):
        held = [s.imu for s in items[k : k + 4] if s.imu is not None]
        out.append(replace(items[k + 3], imu=joined(held)))
    return out + items[n + 32 :]


def _kidnapped(items: list[Shown]) -> list[Shown]:
    """Into a wall and out at a place that is reached a second and a half later."""
    n = len(items) // 2
    out = _each(_grey(128.0), -6, 6)(items)
    held = [s.imu for s in items[n : n + 31] if s.imu is not None]
    return [*out[:n], replace(items[n + 30], imu=joined(held)), *items[n + 31 :]]


def no_texture(items: list[Shown], first: int, count: int) -> list[Shown]:
    """A blank wall from a frame on, for so many frames."""
    return _each(_grey(128.0), first - len(items) // 2, count)(items)


FAULTS: dict[str, Callable[[list[Shown]], list[Shown]]] = {
    "none": lambda items: items,
    "black, 0.3 s": _each(_grey(6.0), 0, 6),
    "black, 2 s": _each(_grey(6.0), 0, 40),
    "blank wall, 1.5 s": _each(_grey(128.0), 0, 30),
    "no contrast, 1 s": _each(_gain(0.03, 100.0), 0, 20),
    "too bright, 1 s": _each(_gain(2.4), 0, 20),
    "too dark, 1 s": _each(_gain(0.15), 0, 20),
    "one eye only, 1 s": _each(lambda f: replace(f, right=None), 0, 20),
    "frozen, 0.6 s": _frozen,
    "four times as fast": _fast,
    "out at another place": _kidnapped,
    "two walls": lambda items: _each(_grey(128.0), 28, 14)(_each(_grey(128.0), 0, 14)(items)),
}  # what is done to the middle of a flight


# how a pose errs


@dataclass(frozen=True, slots=True)
class Judged:
    """One frame. error: (6,) of T_o_b against the flight's start, as cov_o tells of it. off_m, off_rad: of the pose
    that is claimed, T_m_b or where there is none T_o_b, against the flight's start: all submaps begin in the axes of o.
    tilt_rad: of T_l_b, nan while it is held back.
    """

    estimate: Estimate
    error: F64
    off_m: float
    off_rad: float
    tilt_rad: float

    @property
    def nees(self) -> float:
        """Normalised squared error of T_o_b; 6 is what an honest covariance gives on average."""
        return float(self.error @ np.linalg.solve(self.estimate.cov_o + 1e-14 * np.eye(6), self.error))


def fly(
    rig: CameraRig, imu: ImuCalibration | None, items: list[Shown], words: Vocabulary | None = None
) -> Iterator[Judged]:
    """Fly and judge each frame."""
    agent = Agent(rig, imu, AgentConfig(), Identity(AgentId(0), 0), NoBaseChannel(), words)
    begin: tuple[F64, F64] | None = None
    for item in items:
        step = StepInput(item.frame, item.imu if imu is not None else None)
        e = agent.step(step, item.frame.t_ns).estimate
        assert e is not None
        if begin is None:
            begin = e.T_o_b, item.truth
        error = _error(begin, e.T_o_b, item.truth)
        claimed = error
        if e.T_m_b is not None:
            claimed = _error(begin, e.T_m_b, item.truth)
        tilt = float("nan")
        if e.T_l_b is not None:
            tilt = float(np.arccos(np.clip((e.T_l_b[:3, :3] @ item.truth[:3, :3].T)[2, 2], -1.0, 1.0)))
        yield Judged(e, error, float(np.linalg.norm(claimed[:3])), float(np.linalg.norm(claimed[3:])), tilt)


def _error(begin: tuple[F64, F64], T_a_b: F64, truth: F64) -> F64:
    """(6,) [translation in a, rotation about the body's axes] of a pose against where (estimate, truth) it began."""
    found, true = se3.inverse(begin[0]) @ T_a_b, se3.inverse(begin[1]) @ truth
    moved = begin[0][:3, :3] @ (found[:3, 3] - true[:3, 3])
    return np.concatenate([moved, se3.so3_log(true[:3, :3].T @ found[:3, :3])])
