"""Readers of outside bytes beyond packets: questions, stores and files; each with valid input to mutate."""

import contextlib
import json
import random
import sqlite3
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from kiteline_basestation.config import BaseConfig
from kiteline_basestation.management import VERBS, Command
from kiteline_basestation.mapper import Mapper, MapperInput
from kiteline_basestation.runtime.imports import import_map
from kiteline_basestation.station import Station
from kiteline_basestation.store.checksums import sum_of
from kiteline_basestation.store.saved_map import SavedMap, SavedValues, pack, unpack
from kiteline_basestation.store.store import FILE, Batch, Store, read
from kiteline_codec.schema import Key
from kiteline_core.errors import KitelineError
from kiteline_core.frame import EncodedImage, Frame
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_core.ids import AgentId
from kiteline_hw.calibration.files import read_calibration
from kiteline_hw.logs.mcap_log import LogReader, LogWriter
from kiteline_hw.logs.rig_json import rig_from_json, rig_to_json
from kiteline_hw.sensors.images import decode_depth, decode_grey
from kiteline_hw.sensors.raw_pixels import BadImage
from kiteline_hw.sources import euroc, mcap, tum
from kiteline_hw.sources.text_files import read_yaml

ERRORS: tuple[type[Exception], ...] = (KitelineError, BadImage)
_CAMERA = CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5)
_SENSOR = (
    "sensor_type: camera\nT_BS:\n  rows: 4\n  cols: 4\n  data: [1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1]\n"
    "rate_hz: 20\nresolution: [64, 48]\ncamera_model: pinhole\nintrinsics: [50, 50, 31.5, 23.5]\n"
    "distortion_model: radial-tangential\ndistortion_coefficients: [0, 0, 0, 0]\n"
)


@dataclass(frozen=True, slots=True)
class FuzzTarget:
    """Takes bytes, and raises one of ERRORS or nothing. samples: valid bytes."""

    name: str
    take: Callable[[bytes, random.Random], object]
    samples: tuple[bytes, ...]


def fuzz_targets(folder: Path) -> list[FuzzTarget]:
    """All of them. folder: for files."""
    images = {ending: _image(ending) for ending in (".png", ".jpg", ".bmp", ".pgm", ".tiff", ".webp")}
    flight, table = folder / "flight" / "mav0" / "cam0", folder / "rgbd"
    for place in (flight / "data", table / "rgb"):
        place.mkdir(parents=True)
        (place / "1.png").write_bytes(images[".png"])
    (flight / "sensor.yaml").write_text(_SENSOR)
    (table / "camera.yaml").write_text("fx: 50\nfy: 50\ncx: 31.5\ncy: 23.5\nwidth: 64\nheight: 48\n")
    log, store = _log(folder / "log.mcap", images[".png"]), _store(folder / "store")
    rig = json.dumps(rig_to_json(CameraRig(_CAMERA, None, np.eye(4), None), None)).encode()

    def by_file(name: str, take: Callable[[Path], object]) -> Callable[[bytes, random.Random], object]:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)

        def written(data: bytes, draw: random.Random) -> object:
            path.write_bytes(data)
            return take(path)

        return written

    mapper = Mapper(BaseConfig())
    sensors = (_SENSOR.encode(), b"[" * 4000, b"{a: " * 4000)
    return [
        FuzzTarget("question", lambda data, draw: _ask(mapper, data, draw), _questions()),
        FuzzTarget("saved map", lambda data, draw: unpack(data), (_packed(),)),
        FuzzTarget("store", by_file(f"fuzzed/{FILE}", read), (store,)),
        FuzzTarget("store's rows", by_file(f"rows/{FILE}", read), tuple(_odd_rows(folder / "odd", store))),
        FuzzTarget("log", by_file("fuzzed.mcap", _read_log), (log,)),
        FuzzTarget("log as a source", by_file("source.mcap", _open_log), (log,)),
        FuzzTarget("ROS 2 bag", by_file("bag.db3", _open_log), (_sqlite_bag(), _computed_bag())),
        FuzzTarget("log to import", by_file("import.mcap", lambda path: import_map(path, _no_station)), (log,)),
        FuzzTarget("rig", lambda data, draw: rig_from_json(_json(data)), (rig,)),
        FuzzTarget("image", lambda data, draw: decode_grey(EncodedImage(data, "png")), tuple(images.values())),
        FuzzTarget(
            "depth image", lambda data, draw: decode_depth(EncodedImage(data, "png/1000")), tuple(images.values())
        ),
        FuzzTarget("calibration", by_file("c.yaml", lambda path: read_calibration(str(path))), sensors),
        FuzzTarget("sensor file", by_file("s.yaml", lambda path: read_yaml(path, "a sensor")), sensors),
        FuzzTarget(
            "EuRoC's listing", by_file("flight/mav0/cam0/data.csv", lambda _: _frames(euroc, flight.parent.parent)),
            (b"1,1.png\n2,1.png\n",),
        ),
        FuzzTarget("TUM's listing", by_file("rgbd/rgb.txt", lambda _: _frames(tum, table)), (b"1.0 rgb/1.png\n",)),
    ]  # fmt: skip


def _ask(mapper: Mapper, data: bytes, draw: random.Random) -> object:
    verb = draw.choice([*VERBS, "x"])
    text = data.decode(errors="replace") if draw.random() < 0.7 else data.decode("latin-1")
    (answer,) = mapper.step(MapperInput((), commands=(Command(1, verb, text),)), 1).answers
    json.loads(answer.text)
    return answer


def _questions() -> tuple[bytes, ...]:
    texts = (
        '{"map": "0.0.0", "into": "1.0.0", "T_into_map": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}',
        '{"map": "0.0.0", "name": "hall"}',
        "[" * 1000,
        '{"map": ' * 300,
        "1" * 400,
        '{"map": ' + "9" * 5000 + "}",
        "{}",
    )
    return tuple(text.encode() for text in texts)


def _json(data: bytes) -> dict[str, object]:
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        value = None
    return value if isinstance(value, dict) else {}


def _image(ending: str) -> bytes:
    pixels = np.random.default_rng(0).integers(0, 255, (48, 64)).astype(np.uint8)
    return bytes(cv2.imencode(ending, pixels)[1].tobytes())


def _packed() -> bytes:
    return pack(SavedMap({AgentId(1): SavedValues({Key(3, 5): b"head"}, {Key(16, 5): b"pose"})}, {"mapper": "{}"}))


def _store(folder: Path) -> bytes:
    store = Store(folder)
    store.write(Batch(rows=[(1, 0, 3, n, 0, bytes(40)) for n in range(20)], texts={"mapper": "{}"}))
    store.close()
    with sqlite3.connect(folder / FILE) as db:
        db.execute("PRAGMA journal_mode = DELETE")
    db.close()
    return (folder / FILE).read_bytes()


def _odd_rows(folder: Path, store: bytes) -> list[bytes]:
    """Stores with sound pages that hold what no base writes."""
    folder.mkdir()
    out = []
    rows = (("a", 0, 3, 5, 0, b"x"), (1, 9, 3, 5, 0, b"x"), (1, 0, 3, -5, 0, b"x"), (1, 0, 300, 5, 0, b"x"))
    changes: list[tuple[str, tuple[object, ...]]] = [
        ("INSERT INTO code VALUES (?, ?, ?, ?, ?, ?, ?)", (*row, sum_of(row[:5], b"x"))) for row in rows
    ]
    changes += [("CREATE VIEW v AS SELECT hex(zeroblob(1000000000))", ()),
                ("CREATE TRIGGER t AFTER INSERT ON code BEGIN DELETE FROM state; END", ())]  # fmt: skip
    for sql, values in changes:
        path = folder / "map.sqlite"
        path.write_bytes(store)
        with sqlite3.connect(path) as db:
            db.execute(sql, values)
        db.close()
        out.append(path.read_bytes())
    return out


def _log(path: Path, image: bytes) -> bytes:
    pixels = np.zeros((48, 64), np.uint8)
    with LogWriter(path, {"role": "agent", "agent": "0"}) as log:
        log.rig(1, CameraRig(_CAMERA, None, np.eye(4), None), None)
        for t_ns in (1, 2):
            log.frame(Frame(t_ns, pixels, None, None, (EncodedImage(image, "png"),)))
            log.json("/events", t_ns, {"reset": 1})
            log.fields("/estimate", t_ns, {"quality": 90, "T_o_b": np.eye(4)})
    return path.read_bytes()


def _read_log(path: Path) -> None:
    with LogReader(path) as log:
        for message in log.messages():
            for read_as in (message.blob, message.json, message.image, message.imu, message.odometry):
                with contextlib.suppress(KitelineError):
                    read_as()


def _open_log(path: Path) -> None:
    for _ in mcap.open_source(str(path), False, True):
        pass


def _sqlite_bag() -> bytes:
    """A ROS 2 bag in SQLite storage with one message."""
    with contextlib.closing(sqlite3.connect(":memory:")) as bag:
        bag.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
            "INSERT INTO topics VALUES(1, '/image', 'sensor_msgs/msg/CompressedImage', 'cdr');"
            "INSERT INTO messages VALUES(1, 1, 5, x'00010000000000000000000001000000000000000000000000000000');"
        )
        return bag.serialize()


def _computed_bag() -> bytes:
    """The same with messages that are computed without end."""
    with contextlib.closing(sqlite3.connect(":memory:")) as bag:
        bag.deserialize(_sqlite_bag())
        bag.executescript(
            "ALTER TABLE messages RENAME TO stored;"
            "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n)"
            " SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM n;"
        )
        return bag.serialize()


def _no_station(metadata: object) -> Station:
    raise KitelineError("a base's log is not imported here")


def _frames(module: object, folder: Path) -> None:
    for _ in module.open_source(str(folder), True, False):  # type: ignore[attr-defined]
        pass
