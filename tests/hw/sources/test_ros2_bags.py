"""ROS 2 bags in SQLite storage, in parts, packed message by message; and bags that are refused with what helps."""

import os
import sqlite3
import threading
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.writer import Writer

from kiteline_hw.logs.mcap_file import McapFile, RawMessage
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.bags.ros2_definitions import definition_of
from kiteline_hw.sources.mcap_messages import KINDS
from kiteline_hw.sources.open import open_source
from tests.hw.sources.camera_messages import START_NS, quaternion, read, xyz
from tests.hw.sources.ros2_bags import Bag, check_stereo, stereo_bag

_TABLES = """
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
    serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
    data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
"""


def db3(bag: Bag, *paths: Path, packed: bool = False) -> None:
    """Write a bag as rosbag2 does, in as many parts as there are paths."""
    mcap = McapFile(bag.write(paths[0].with_suffix(".tmp")))
    messages = list(mcap.messages())
    share = -(-len(messages) // len(paths))
    for k, path in enumerate(paths):
        _write_part(path, mcap, messages[k * share : (k + 1) * share], packed, first_id=5 - k)
    paths[0].with_suffix(".tmp").unlink()


def _write_part(path: Path, mcap: McapFile, messages: list[RawMessage], packed: bool, first_id: int) -> None:
    with closing(sqlite3.connect(path)) as file:
        file.executescript(_TABLES)
        for channel, described in mcap.channels.items():
            schema = mcap.schema_of(channel)
            row = (channel + first_id, described.topic, schema.name, "cdr", "")
            file.execute("INSERT INTO topics VALUES(?,?,?,?,?)", row)
        for m in messages:
            data = zstandard.compress(m.data) if packed else m.data
            values = (m.channel + first_id, m.log_ns, data)
            file.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES(?,?,?)", values)
        file.commit()


@pytest.mark.parametrize("packed", [False, True])
def test_a_sqlite_bag_is_read_as_the_same_bag_in_mcap(tmp_path: Path, packed: bool) -> None:
    file = tmp_path / "flight #1?_0.db3"
    db3(stereo_bag(), file, packed=packed)
    check_stereo(open_source(str(file)))
    check_stereo(open_source(f"mcap:{file}"))
    assert sorted(path.name for path in tmp_path.iterdir()) == [file.name], "nothing is written beside a bag"


def test_the_parts_of_a_split_bag_follow_each_other(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    db3(stereo_bag(20), tmp_path / "b_0.db3", tmp_path / "b_1.db3", tmp_path / "b_2.db3")
    check_stereo(open_source(str(tmp_path)), 20)


def mcap_parts(folder: Path, names: list[str], bag: Bag) -> list[Path]:
    """Write a bag in as many parts as there are names; channels have other numbers in each."""
    folder.mkdir(exist_ok=True)
    share = -(-len(bag.messages) // len(names))
    paths = []
    for k, name in enumerate(names):
        part = Bag()
        if k:  # a topic that no other part has moves the numbers
            part.add(bag.messages[k * share][0], f"/only/{k}", "geometry_msgs/msg/PoseStamped", "x",
                     pose={"position": xyz(np.zeros(3)), "orientation": quaternion(np.eye(4))})  # fmt: skip
        part.messages += bag.messages[k * share : (k + 1) * share]
        paths.append(part.write(folder / name))
    return paths


@pytest.mark.parametrize("listed", [False, True])
def test_the_parts_of_a_split_bag_in_mcap_follow_each_other(tmp_path: Path, listed: bool) -> None:
    names = ["late.mcap", "early.mcap"] if listed else [f"b_{k}.mcap" for k in (9, 10, 11)]
    if listed:
        (tmp_path / "metadata.yaml").write_text("relative_file_paths:\n- late.mcap\n- early.mcap\n")
    mcap_parts(tmp_path, names, stereo_bag(20))
    source = open_source(str(tmp_path))
    check_stereo(source, 20)
    assert source.frame_count == 20 and source.imu is not None
    assert source.imu.rate_hz == pytest.approx(200, rel=0.1)


def test_the_part_of_a_split_bag_that_was_cut_is_read_up_to_the_cut(tmp_path: Path) -> None:
    paths = mcap_parts(tmp_path, ["b_0.mcap", "b_1.mcap"], stereo_bag(20))
    data = paths[1].read_bytes()
    paths[1].write_bytes(data[: len(data) // 2])
    source = open_source(str(tmp_path))
    frames, _ = read(source)
    assert 11 < len(frames) < 20 and any("b_1.mcap is cut" in note for note in source.report.notes)


def test_files_that_are_no_parts_of_one_bag_are_refused(tmp_path: Path) -> None:
    mcap_parts(tmp_path / "names", ["monday.mcap", "tuesday.mcap"], stereo_bag())
    mcap_parts(tmp_path / "times", ["a_0.mcap"], stereo_bag(60))
    mcap_parts(tmp_path / "times", ["a_1.mcap"], stereo_bag(40))
    mcap_parts(tmp_path / "topics", ["a_0.mcap"], stereo_bag())
    other = Bag()
    other.odometry(START_NS + 10**9, "/wheels", "base_link", [1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    other.write(tmp_path / "topics" / "a_1.mcap")
    for name, why in (("names", "not named"), ("times", r"begins \d\.\d s before"), ("topics", "shares no topic")):
        with pytest.raises(SourceError, match=rf"2 MCAP files.*{why}.*kiteline log merge OUT\.mcap"):
            open_source(str(tmp_path / name))


def test_bags_of_several_flights_in_a_folder_are_not_joined(tmp_path: Path) -> None:
    db3(stereo_bag(), tmp_path / "morning_0.db3", tmp_path / "morning_1.db3")
    db3(stereo_bag(), tmp_path / "noon_0.db3")
    with pytest.raises(SourceError, match="3 SQLite bags: name one"):
        open_source(str(tmp_path))
    (tmp_path / "metadata.yaml").write_text("relative_file_paths: [morning_0.db3, morning_1.db3, noon_0.db3]\n")
    assert open_source(str(tmp_path)).frame_count


def test_a_named_pipe_in_a_folder_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    found: list[BaseException] = []

    def opened() -> None:
        try:
            open_source(str(tmp_path))
        except SourceError as error:
            found.append(error)

    thread = threading.Thread(target=opened, daemon=True)
    thread.start()
    thread.join(10.0)
    assert "layout not recognised" in str(found)


def test_messages_packed_one_by_one_in_mcap(tmp_path: Path) -> None:
    plain = McapFile(stereo_bag().write(tmp_path / "plain.tmp"))
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2", "test")
        numbers = {}
        for number, channel in plain.channels.items():
            schema = plain.schema_of(number)
            known = writer.register_schema(schema.name, schema.encoding, schema.data)
            numbers[number] = writer.register_channel(channel.topic, "cdr", known)
        for m in plain.messages():
            writer.add_message(numbers[m.channel], m.log_ns, zstandard.compress(m.data), m.log_ns)
        writer.finish()
    check_stereo(open_source(str(tmp_path / "a.mcap")))


def test_every_message_of_ros_that_is_used_has_a_definition() -> None:
    for name in KINDS:
        assert (definition_of(name) is not None) == ("/msg/" in name)


def test_what_cannot_be_read_says_what_helps(tmp_path: Path) -> None:
    ros1 = tmp_path / "old" / "flight.bag"
    ros1.parent.mkdir()
    ros1.write_bytes(b"#ROSBAG V2.0\n" + bytes(50))
    for path in (ros1, ros1.parent):
        with pytest.raises(SourceError, match=r"ROS 1.*rosbags-convert --src flight\.bag"):
            open_source(str(path))
    for name, head in (
        ("a.mp4", b"\0\0\0\x18ftypmp42"),
        ("b.avi", b"RIFF\x10\0\0\0AVI LIST"),
        ("c.mkv", b"\x1aE\xdf\xa3\x01"),
    ):
        video = tmp_path / name[0] / name
        video.parent.mkdir()
        video.write_bytes(head + bytes(50))
        for path in (video, video.parent):
            with pytest.raises(SourceError, match=rf"a video.*ffmpeg -i {name}.*images:'images/\*\.png\?fps=20'"):
                open_source(str(path))
    whole = tmp_path / "packed" / "flight_0.db3.zstd"
    whole.parent.mkdir()
    whole.write_bytes(zstandard.compress(b"SQLite format 3\0"))
    for path in (whole, whole.parent):
        with pytest.raises(SourceError, match=r"zstd -d flight_0\.db3\.zstd"):
            open_source(str(path))


def test_a_database_that_is_no_bag_is_refused(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "other.db3")) as file:
        file.execute("CREATE TABLE songs(id INTEGER)")
    with pytest.raises(SourceError, match="tables topics and messages"):
        open_source(str(tmp_path / "other.db3"))


COUNTED = "WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n LIMIT 3)"  # without the limit: no end


@pytest.mark.parametrize(
    "computed",
    [
        (
            f"ALTER TABLE messages RENAME TO stored; CREATE VIEW messages AS {COUNTED} "
            "SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM n"
        ),
        (
            f"ALTER TABLE topics RENAME TO stored; CREATE VIEW topics AS {COUNTED} "
            "SELECT id, '/a' AS name, 'b' AS type, 'cdr' AS serialization_format FROM n"
        ),
        (
            f"ALTER TABLE messages RENAME TO stored; CREATE VIEW Messages AS {COUNTED} "
            "SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM n"
        ),
        "ALTER TABLE messages ADD COLUMN more BLOB AS (zeroblob(900000000))",
    ],
)
def test_a_bag_whose_tables_are_computed_is_refused(tmp_path: Path, computed: str) -> None:
    file = tmp_path / "a.db3"
    db3(stereo_bag(), file)
    with closing(sqlite3.connect(file)) as bag:
        bag.executescript(computed)
    with pytest.raises(SourceError, match="tables topics and messages"):
        open_source(str(file))


def test_a_damaged_bag_raises_source_errors_only(tmp_path: Path) -> None:
    good = tmp_path / "good.db3"
    db3(stereo_bag(), good)
    data = good.read_bytes()
    for k, at in enumerate(range(100, len(data), len(data) // 12)):
        for bad in (data[:at], data[:at] + b"\xff" * 40 + data[at + 40 :]):
            path = tmp_path / f"bad{k}.db3"
            path.write_bytes(bad)
            with suppress(SourceError):
                read(open_source(str(path)))
