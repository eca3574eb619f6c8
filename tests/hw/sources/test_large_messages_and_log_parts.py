"""Messages that are too large are named, not dropped silently; a kiteline log in several files is one recording."""

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.writer import Writer

from kiteline_core.frame import Frame
from kiteline_core.geometry.cameras import CameraModel, CameraRig
from kiteline_hw.logs import mcap_file
from kiteline_hw.logs.log_budget import LogBudget
from kiteline_hw.logs.mcap_file import McapFile
from kiteline_hw.logs.mcap_log import LogWriter
from kiteline_hw.ports import FrameSource, SourceError
from kiteline_hw.sources.bags import bag_files, sqlite_bag
from kiteline_hw.sources.bags.bag_files import unpacked
from kiteline_hw.sources.bags.sqlite_bag import SqliteBag
from kiteline_hw.sources.mcap_messages import BadMessage
from kiteline_hw.sources.open import open_source

MOST = 5000  # bytes, in place of 64 MiB


def test_a_message_outside_of_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_file, "MOST_CHUNK_BYTES", MOST)
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start("", "test")
        channel = writer.register_channel("/a", "json", writer.register_schema("a", "jsonschema", b"{}"))
        for k, size in enumerate((10, MOST + 1, 20)):
            writer.add_message(channel, k, bytes(size), k)
        writer.finish()
    file = McapFile(tmp_path / "a.mcap")
    assert [len(message.data) for message in file.messages()] == [10, 20]
    assert len(file.notes) == 1 and f"left out, expected at most {MOST}" in file.notes[0]


def test_a_row_of_a_sqlite_bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite_bag, "MOST_CHUNK_BYTES", MOST)
    with closing(sqlite3.connect(tmp_path / "a.db3")) as file:
        file.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
            "INSERT INTO topics VALUES(1, '/a', 'sensor_msgs/msg/Image', 'cdr');"
        )
        for k, size in enumerate((10, 4 * MOST, 20)):
            file.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)", (k, bytes(size)))
        file.commit()
    bag = SqliteBag([tmp_path / "a.db3"])
    assert [len(message.data) for message in bag.messages()] == [10, 20]
    assert bag.notes == [f"a.db3: messages left out that are larger than {MOST} bytes"]


def test_a_packed_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag_files, "MOST_CHUNK_BYTES", MOST)
    assert unpacked(zstandard.compress(bytes(MOST))) == bytes(MOST)
    with pytest.raises(BadMessage, match=f"larger than {MOST} bytes"):
        unpacked(zstandard.compress(bytes(MOST + 1)))


def log_in_parts(folder: Path, name: str = "boot00003", first_ns: int = 0) -> int:
    """Write a log that goes on in further files; returns their number."""
    folder.mkdir(exist_ok=True)
    camera = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)
    random = np.random.default_rng(2)
    budget = LogBudget(folder, "boot", 160_000, 0)
    with LogWriter(folder / f"{name}.mcap", {"role": "agent"}, budget=budget) as log:
        log.rig(first_ns, CameraRig(camera, None, np.eye(4), None, has_body=False), None)
        for k in range(20):
            log.frame(Frame(first_ns + 50_000_000 * k, random.integers(0, 256, (48, 64), np.uint8)))
    return len(list(folder.glob(f"{name}*.mcap")))


def test_the_parts_of_a_log_are_one_recording(tmp_path: Path) -> None:
    assert log_in_parts(tmp_path / "a") > 2
    source = open_source(str(tmp_path / "a"))
    frames = [item for item in source if isinstance(item, Frame)]
    assert [frame.t_ns for frame in frames] == [50_000_000 * k for k in range(20)] and source.frame_count == 20
    (tmp_path / "a" / "boot00003.mcap").unlink()  # the oldest part goes first
    assert 0 < len([item for item in open_source(str(tmp_path / "a")) if isinstance(item, Frame)]) < 20


def test_a_part_that_is_missing_between_others_is_told(tmp_path: Path) -> None:
    count = log_in_parts(tmp_path / "a")
    (tmp_path / "a" / "boot00003.mcap").unlink()
    source = open_source(str(tmp_path / "a"))
    assert frames_of(source)[-1] == 19 and not source.report.notes  # the oldest part was deleted to make room
    for n in range(2, count - 1):
        (tmp_path / "a" / f"boot00003_{n}.mcap").unlink()
    source = open_source(str(tmp_path / "a"))
    assert 0 < len(frames_of(source)) < 18
    verb = "is" if count == 4 else "are"
    missing = ", ".join(map(str, range(2, count - 1)))
    assert source.report.notes == [f"file cut: of its parts, {missing} {verb} missing"]
    for old, new in (("boot00003_1", "boot00003_20261128"), (f"boot00003_{count - 1}", "boot00003_20261130")):
        (tmp_path / "a" / f"{old}.mcap").rename(tmp_path / "a" / f"{new}.mcap")
    source = open_source(str(tmp_path / "a"))
    assert frames_of(source) and not source.report.notes  # dates


def frames_of(source: FrameSource) -> list[int]:
    """Numbers of the frames of a log in parts."""
    return [item.t_ns // 50_000_000 for item in source if isinstance(item, Frame)]


def test_the_first_part_of_a_log_is_read_with_the_later_ones(tmp_path: Path) -> None:
    assert log_in_parts(tmp_path / "a") > 3
    log_in_parts(tmp_path / "b", "boot00004")
    for path in (tmp_path / "b").iterdir():  # another flight beside it
        path.rename(tmp_path / "a" / path.name)
    first = tmp_path / "a" / "boot00003.mcap"
    source = open_source(str(first))
    assert frames_of(source) == list(range(20)) and source.frame_count == 20
    assert source.name == f"mcap:{first}" and not source.report.skipped
    later = frames_of(open_source(str(tmp_path / "a" / "boot00003_1.mcap")))
    assert 0 < len(later) < 10  # a later part is that part alone
    (tmp_path / "a" / "boot00003_2.mcap").unlink()
    source = open_source(str(first))
    assert frames_of(source) == list(range(later[-1] + 1))
    assert source.report.notes == ["file cut: its part 2 is missing"]
    (tmp_path / "a" / "boot00003_1.mcap").unlink()
    source = open_source(str(first))
    assert frames_of(source) == list(range(later[0]))
    assert source.report.notes == ["file cut: its part 1 is missing"]


@pytest.mark.parametrize("name", ["flight [1]", "flight_7", "a*b?", "line\nbreak"])
def test_the_parts_of_a_log_of_any_name_are_read(name: str, tmp_path: Path) -> None:
    """Brackets in the name hid the later parts."""
    log_in_parts(tmp_path / "a", name)
    assert len(list((tmp_path / "a").iterdir())) > 2
    assert frames_of(open_source(str(tmp_path / "a" / f"{name}.mcap"))) == list(range(20))


def test_a_log_without_images_says_why(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap", {"role": "agent"}) as log:
        log.rig(0, CameraRig(CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5), None, np.eye(4), None, has_body=False), None)
    with pytest.raises(SourceError, match=r"no images on .*: \[agent.log\] every was 0"):
        open_source(str(tmp_path / "a.mcap"))


def test_logs_of_two_flights_are_not_joined(tmp_path: Path) -> None:
    log_in_parts(tmp_path / "a")
    log_in_parts(tmp_path / "a", "boot00004", 10**12)
    with pytest.raises(SourceError, match="no parts of one bag"):
        open_source(str(tmp_path / "a"))


def test_a_folder_where_one_log_is_expected_is_answered_with_its_first_part(tmp_path: Path) -> None:
    log_in_parts(tmp_path / "a")
    with pytest.raises(SourceError, match=r"a folder: expected one of its \*\.mcap files, such as .*/boot00003\.mcap;"):
        McapFile(tmp_path / "a")
