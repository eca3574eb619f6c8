"""Place recognition: share of revisits found, false matches accepted, and the CPU of a query.

Simulated flights along recorded drone paths, in worlds whose seeds the vocabulary was not trained on. Each frame
queries all frames of its own flight that are older than four seconds and all frames of the other flights. A candidate
is accepted when P3P over its matches has enough inliers; it is right when that pose is the true one.
"""

import time
from dataclasses import dataclass

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging import features
from kiteline_agent.tracking.frame_images import depth_at
from kiteline_bench.harness.bars import Bar, Bench, at_most, is_true
from kiteline_core.arrays import F64, U8
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import Rectifier
from kiteline_core.imaging import matching
from kiteline_core.places.place_index import PlaceIndex
from kiteline_core.pose.pnp import solve_pnp
from kiteline_hw.sim.source import open_sim
from kiteline_hw.system.vocabulary import shipped_vocabulary

TITLE = "Places"


FLIGHTS = (("room", "V1_02_medium.txt"), ("hall", "MH_03_medium.txt"), ("hall", "MH_01_easy.txt"))
_EVERY = 20  # frames between two places: 1 s
_OLD = 4  # places: a younger one is no revisit
_NEAR_M, _NEAR_RAD = 0.8, 0.44  # distance and angle between the views of a revisit
_ACCEPTED = 25  # inliers of P3P
_RIGHT_M = 0.3
_TRIED = 5  # candidates a query
_PLACES = 1000


@dataclass(frozen=True, slots=True)
class _Place:
    flight: int
    T_w_c: F64
    uv: F64
    octave: U8
    angle: U8
    descriptor: U8
    xyz: F64  # in the camera; NaN where there is no depth
    camera: F64


def run(bench: Bench) -> list[Bar]:
    """All bars."""
    flights = []
    for number, (scene, path) in enumerate(FLIGHTS):
        bench.say(f"rendering {scene} along {path}")
        flights.append(_places(number, scene, bench.source(f"trajectories/{path}")))
    revisits = found = accepted = others = 0
    for flight in flights:
        index, known = PlaceIndex(shipped_vocabulary()), {}
        for key, place in enumerate(p for other in flights if other is not flight for p in other):
            index.add(key, place.descriptor)
            known[key] = place
        for k, place in enumerate(flight):
            if k >= _OLD:
                key = 10_000 + k - _OLD
                index.add(key, flight[k - _OLD].descriptor)
                known[key] = flight[k - _OLD]
            again = any(_near(place, old) for old in flight[: max(k - _OLD + 1, 0)])
            verdicts = [_verdict(place, known[c]) for c in index.query(place.descriptor, limit=_TRIED).keys.tolist()]
            revisits += again
            found += again and "right" in verdicts
            accepted += verdicts.count("wrong")
            others += verdicts.count("refused") + verdicts.count("wrong")
    share = found / max(revisits, 1)
    return [
        is_true("revisits found", ">= 70 % of >= 50", share >= 0.7 and revisits >= 50, f"{share:.0%} of {revisits}"),
        is_true("false candidates accepted", "0 of >= 500", accepted == 0 and others >= 500, f"{accepted} of {others}"),
        at_most("query among 1000 places, CPU", _query_ms(flights), 1.0, "ms"),
    ]


def _places(number: int, scene: str, path: str) -> list[_Place]:
    source = open_sim(scene, seed=7, trajectory=path, imu=False, depth=True)
    rectifier, cameras, truth = Rectifier(source.rig), source.cameras(), source.ground_truth
    config = AgentConfig()
    detector = features.DetectorConfig(
        cell_px=config.relocalisation.cell_px, max_corners=config.relocalisation.max_corners
    )
    c = rectifier.camera
    out = []
    for k in range(0, source.frame_count or 0, _EVERY):
        frame = source.render(k, cameras)
        assert frame.depth_m is not None and truth is not None
        pyramid = features.build_pyramid(rectifier.left(frame.left), config.pyramid.levels)
        corners = features.detect(pyramid, np.zeros((0, 2)), detector)
        angle, descriptor = features.describe(pyramid, corners.uv, corners.octave)
        z = depth_at(rectifier.depth(frame.depth_m), corners.uv)
        z = np.where(z > 0.0, z, np.nan)
        xy = (corners.uv - np.array([c.cx, c.cy])) / np.array([c.fx, c.fy])
        xyz = np.column_stack([xy * z[:, None], z])
        camera = np.array([c.fx, c.fy, c.cx, c.cy, c.bf])
        out.append(
            _Place(number, truth.T_w_b[k] @ c.T_b_c, corners.uv, corners.octave, angle, descriptor, xyz, camera)
        )  # fmt: skip
    return out


def _near(a: _Place, b: _Place) -> bool:
    T = se3.inverse(a.T_w_c) @ b.T_w_c
    return bool(np.linalg.norm(T[:3, 3]) < _NEAR_M and T[2, 2] > np.cos(_NEAR_RAD))


def _verdict(place: _Place, old: _Place) -> str:
    """Judge a candidate: "refused", or "right" or "wrong" where it is accepted."""
    has = np.flatnonzero(np.isfinite(old.xyz[:, 2]))
    matches = matching.match(old.descriptor[has], old.angle[has], place.descriptor, place.angle)
    rows = has[matches.a]
    observed = np.column_stack([place.uv[matches.b], np.full(len(rows), -1.0)])
    fit = solve_pnp(old.xyz[rows], np.zeros((len(rows), 3)), observed, place.octave[matches.b], place.camera, 1)
    if fit is None or fit.inliers < _ACCEPTED:
        return "refused"
    error = fit.T_c_m @ se3.inverse(old.T_w_c) @ place.T_w_c
    right = place.flight == old.flight and np.linalg.norm(error[:3, 3]) < _RIGHT_M
    return "right" if right else "wrong"


def _query_ms(flights: list[list[_Place]]) -> float:
    """Median CPU of a query among 1000 places."""
    places = [p for flight in flights for p in flight]
    index, times = PlaceIndex(shipped_vocabulary()), []
    for key in range(_PLACES):
        index.add(key, places[key % len(places)].descriptor)
    for place in places[:100]:
        start = time.process_time()
        index.query(place.descriptor)
        times.append((time.process_time() - start) * 1e3)
    return float(np.median(times))
