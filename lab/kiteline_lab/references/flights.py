"""The flights whose logs are kept, and how their logs are made."""

import contextlib
import json
import math
import os
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer

from kiteline_agent.runtime import flight_log as agent_log
from kiteline_basestation.runtime import flight_log as base_log
from kiteline_core.arrays import F32, U8
from kiteline_core.frame import EncodedImage, Frame, ImuBatch, OdometryBatch, joined
from kiteline_core.geometry import se3, tum
from kiteline_hw.logs.mcap_file import McapFile
from kiteline_hw.logs.mcap_log import GROUND_TRUTH, IMU, ODOMETER, RIG, LogWriter
from kiteline_hw.sim.source import open_sim
from kiteline_hw.sources.open import open_source
from kiteline_lab.flights.in_process import fly_in_process
from kiteline_lab.flights.plan import Options, plan

FOLDER = Path("tests/references/kept")
IMAGES = "images.mcap"  # of most kept flights
LEFT_IMAGES = "images-left.mcap"  # one camera takes 3 s to find its scale: fewer and longer
STREET_IMAGES = "images-street.mcap"  # a car's: keyframes come fast, and it is seen far
FRAMES, DEPTH_FRAMES = 32, 14  # frames of it, and of them those with depth
LEFT_FRAMES = 35  # of the latter, every second one of the simulation
STREET_FRAMES, _STREET_HZ = 36, 10.0
_RATE_HZ = 20.0
_QUALITY = 40  # of WebP: 4 kB an image
_DEPTH_STEPS = 50.0  # per metre: steps of 2 cm, which a depth camera has, and which compress well
_LOOKS_AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # a level camera that looks along x
_SIM: dict[str, Any] = {
    "seed": 1, "scale": 0.5, "rest": 0.0, "read_noise": 0.3, "shot_noise": 0.002, "odometry": 50.0,
    "seconds": FRAMES / _RATE_HZ,
}  # fmt: skip
_INPUTS = (RIG, agent_log.STEP, agent_log.IMU, agent_log.ODOMETER, agent_log.PACKETS_IN, base_log.JOB)


@dataclass(frozen=True, slots=True)
class KeptFlight:
    """A flight whose logs are kept. about: in words. frames: first and last + 1 of each agent's. depth: in place of
    the right image. odometer: its samples are given. options: of `kiteline fly`.
    """

    name: str
    about: str
    frames: tuple[tuple[int, int], ...] = ((0, FRAMES),)
    depth: bool = False
    odometer: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)
    images: str = IMAGES


FLIGHTS = (
    KeptFlight("stereo-imu", "a stereo pair with an IMU, a base on a wide link"),
    KeptFlight("mono-imu", "one camera with an IMU, a base on a wide link", ((0, LEFT_FRAMES),),
               options={"mono": True}, images=LEFT_IMAGES),
    KeptFlight("rgbd", "a camera with depth, no IMU, a base on a wide link", ((0, DEPTH_FRAMES),), True,
               options={"imu": False}),
    KeptFlight("lossy", "a stereo pair with an IMU, a base on a slow link that loses a fifth of the packets",
               options={"profile": "radio", "up_bytes_s": 6000, "down_bytes_s": 3000, "loss": 0.2, "delay_s": 0.05}),
    KeptFlight("two-agents", "two stereo pairs without IMU on one street, whose maps are merged",
               ((0, 29), (7, STREET_FRAMES)), options={"imu": False}, images=STREET_IMAGES),
    KeptFlight("ekf", "one camera with an odometer and the Kalman tracker, a base on a wide link",
               odometer=True, options={"mono": True, "imu": False, "tracker": "ekf"}),
)  # fmt: skip


def make_logs(folder: Path, flights: tuple[KeptFlight, ...] = FLIGHTS, *, images: bool = True) -> None:
    """Fly anew; write logs into a folder, and images that it lacks. images: simulate those of the flights anew, too."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in sorted({flight.images for flight in flights}):
        if images or not (folder / name).exists():
            _write_images(folder / name)
    for flight in flights:
        fly_kept(folder, flight)


def fly_kept(folder: Path, flight: KeptFlight) -> None:
    """Fly the kept images anew, and keep the inputs of agents and base."""
    with tempfile.TemporaryDirectory(prefix="kiteline-references-") as scratch:
        out = Path(scratch)
        sources = recordings(folder, flight, out)
        made = plan(Options(tuple(map(str, sources)), out, "local", **flight.options), quiet=True)
        with contextlib.closing(made):
            fly_in_process(made, "local")
        for old in folder.glob(f"{flight.name}.*.mcap"):
            old.unlink()
        for k in range(len(sources)):
            _keep_inputs(out / f"agent{k}" / "log.mcap", agent_log_of(folder, flight, k))
        _keep_inputs(out / "base" / "log.mcap", base_log_of(folder, flight))


def agent_log_of(folder: Path, flight: KeptFlight, agent: int) -> Path:
    """The kept log of an agent."""
    return folder / f"{flight.name}.agent{agent}.mcap"


def base_log_of(folder: Path, flight: KeptFlight) -> Path:
    """The kept log of the base."""
    return folder / f"{flight.name}.base.mcap"


def recordings(folder: Path, flight: KeptFlight, out: Path) -> list[Path]:
    """Recordings of the flight's agents, cut from the kept images."""
    made = []
    for k, (first, last) in enumerate(flight.frames):
        source = open_source(str(folder / flight.images))
        depth = _depth_images(folder / flight.images) if flight.depth else {}
        rig = replace(source.rig, right=None, T_c_r=None, has_depth=True) if flight.depth else source.rig
        made.append(out / f"agent{k}.mcap")
        with contextlib.closing(source), LogWriter(made[-1], {"role": "recording"}) as log:
            number = 0
            for item in source:
                inside = first <= number < last
                if isinstance(item, Frame):
                    if inside:
                        log.frame(_with_depth(item, depth[item.t_ns]) if flight.depth else item)
                    number += 1
                    if number == 1:
                        log.rig(item.t_ns, rig, source.imu)
                elif isinstance(item, ImuBatch) and inside:
                    log.imu(IMU, int(item.t_ns[-1]), item)
                elif isinstance(item, OdometryBatch) and inside and flight.odometer:
                    log.odometer(ODOMETER, int(item.t_ns[-1]), item)
    return made


def _with_depth(frame: Frame, depth: EncodedImage) -> Frame:
    """A frame with a depth image in place of its right one. Its depth is that which readers decode."""
    return replace(frame, right=None, depth_m=np.zeros(frame.left.shape, np.float32),
                   encoded=(frame.encoded[0], depth))  # fmt: skip


def _depth_images(file: Path) -> dict[int, EncodedImage]:
    from kiteline_lab.references.kept_log import read_images

    return {t_ns: found["/kept/depth"].image() for t_ns, found in read_images(file).items() if "/kept/depth" in found}


def _write_images(path: Path) -> None:
    """Simulate the flight and encode its images small."""
    few, street = path.name == LEFT_IMAGES, path.name == STREET_IMAGES
    with tempfile.TemporaryDirectory(prefix="kiteline-references-") as scratch:
        trajectory = Path(scratch) / "path.txt"
        _write_path(trajectory)
        options = {**_SIM, "trajectory": str(trajectory)}
        workers = os.cpu_count() or 1
        if few:
            options |= {"mono": True, "odometry": 0.0, "seconds": 2 * LEFT_FRAMES / _RATE_HZ}
        if street:
            options |= {"trajectory": "", "rate": _STREET_HZ, "imu": False, "odometry": 0.0}
            options["seconds"] = STREET_FRAMES / _STREET_HZ
        source = open_sim("street" if street else "room", workers, **options)
        depths = {} if few or street else _simulated_depths(options, workers)
    truth, number = source.ground_truth, 0
    assert truth is not None
    samples: list[ImuBatch] = []
    with LogWriter(path, {"role": "recording", "source": source.name}) as log:
        log.rig(int(truth.t_ns[0]), source.rig, source.imu)
        for item in source:
            if isinstance(item, ImuBatch):
                samples.append(item)
            elif isinstance(item, OdometryBatch):
                log.odometer(ODOMETER, int(item.t_ns[-1]), item)
            else:
                if not (few and number % 2):
                    if (batch := joined(samples)) is not None:
                        log.imu(IMU, int(batch.t_ns[-1]), batch)
                    samples = []
                    log.pose(GROUND_TRUTH, item.t_ns, "world", truth.T_w_b[number])
                    log.frame(replace(item, encoded=tuple(_webp(i) for i in (item.left, item.right) if i is not None)))
                if (depth := depths.get(item.t_ns)) is not None:
                    log.image("/kept/depth", item.t_ns, _coarse_depth(depth), "left")
                number += 1


def _simulated_depths(options: Mapping[str, Any], workers: int) -> dict[int, F32]:
    """Depth images of the first frames, by stamp."""
    part = {**options, "seconds": DEPTH_FRAMES / _RATE_HZ, "depth": True, "imu": False}
    frames = [item for item in open_sim("room", workers, **part) if isinstance(item, Frame)]
    return {frame.t_ns: frame.depth_m for frame in frames if frame.depth_m is not None}


def _webp(image: U8) -> EncodedImage:
    _, data = cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])
    return EncodedImage(data.tobytes(), "webp")


def _coarse_depth(depth_m: F32) -> EncodedImage:
    steps = np.round(depth_m * _DEPTH_STEPS).astype(np.uint16)
    _, data = cv2.imencode(".png", steps, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    return EncodedImage(data.tobytes(), f"png/{_DEPTH_STEPS:g}")


def _write_path(file: Path) -> None:
    """Write a lively path through the room as a TUM file: monocular scale needs accelerations."""
    lines = []
    for k in range(100):
        t = 0.05 * k
        p = np.array([0.7 * math.sin(1.7 * t + 1.0), 0.6 * math.sin(1.3 * t + 2.5), 1.4 + 0.25 * math.sin(2.1 * t)])
        turn = se3.so3_exp(np.array([0.0, 0.0, 2.2 + 0.2 * math.sin(1.5 * t)]))
        lean = se3.so3_exp(np.array([0.08 * math.sin(2.9 * t), 0.08 * math.sin(2.3 * t), 0.0]))
        lines.append(tum.line(round(t * 1e9), se3.from_rt(turn @ lean @ _LOOKS_AHEAD, p)))
    file.write_text("".join(lines), encoding="ascii")


def _keep_inputs(log: Path, to: Path) -> None:
    """A compressed copy of a log without images and outputs; of its configuration only what the flight chose."""
    source = McapFile(log)
    with to.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start("", "kiteline")
        for record in source.metadata:
            writer.add_metadata(record.name, _kept_metadata(record.metadata))
        numbers: dict[int, int] = {}
        names: dict[int, int] = {}
        for k, channel in sorted(source.channels.items()):
            if channel.topic in _INPUTS or channel.topic.endswith("/packets/in"):
                schema = source.schemas[channel.schema_id]
                if schema.id not in names:
                    names[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[k] = writer.register_channel(
                    channel.topic, channel.message_encoding, names[schema.id], channel.metadata
                )
        for m in source.messages(list(numbers), ordered=False):
            writer.add_message(numbers[m.channel], m.log_ns, m.data, m.publish_ns, m.sequence)
        writer.finish()


def _kept_metadata(metadata: Mapping[str, str]) -> dict[str, str]:
    """Without folders, and with the defaults of today's configuration when it is replayed."""
    spec = json.loads(metadata["spec"])
    tracker = spec.get("tracker", "")
    spec = {key: value for key, value in spec.items() if key not in ("source", "folder", "config")}
    config = f'tracker = "{tracker}"\n' if tracker else ""
    return {**metadata, "spec": json.dumps(spec), "config": config, "source": IMAGES}


def by_name(names: list[str]) -> Iterator[KeptFlight]:
    """The flights of these names, all if there are none. Raises ValueError for an unknown name."""
    known = {flight.name: flight for flight in FLIGHTS}
    for name in names or known:
        if name not in known:
            raise ValueError(f"no kept flight {name!r}; there are: {', '.join(known)}")
        yield known[name]
