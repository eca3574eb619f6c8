"""Logs fly again bit for bit, and a log that was tampered with is found out."""

import errno
import shutil
import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from kiteline_core.frame import Frame, OdometryBatch
from kiteline_hw.logs.log_budget import LogBudget
from kiteline_hw.logs.mcap_file import McapFile
from kiteline_hw.logs.mcap_log import ODOMETER, LogMessage, LogReader, LogWriter
from kiteline_hw.logs.mcap_repair import repair
from kiteline_hw.logs.whole_file import WholeFile
from kiteline_hw.ports import SourceError
from kiteline_hw.sources.open import open_source
from kiteline_lab.flights.fly import fly
from kiteline_lab.flights.plan import Options
from kiteline_lab.replay.logged_steps import Step, check_replayable
from kiteline_lab.replay.replay import ReplayResult, main, replay_agent
from kiteline_lab.tools import logs
from tests.wall import PERIOD_S, STEP_M


@pytest.fixture(scope="module")
def flown(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight with the codec and a bad link."""
    out = tmp_path_factory.mktemp("flown")
    fly(Options((str(recording),), out, "local", loss=0.1), quiet=True)
    return out


def rewritten(log: Path, to: Path, topic: str, number: int, change: bytes, about: dict[str, str] | None = None) -> Path:
    """A copy of a log in which the last bytes of one message are others, and so are these of its metadata."""
    source = McapFile(log)
    with to.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start("", "test")
        for record in source.metadata:
            writer.add_metadata(record.name, {**record.metadata, **(about or {})})
        schemas = {k: writer.register_schema(s.name, s.encoding, s.data) for k, s in sorted(source.schemas.items())}
        channels = {
            k: writer.register_channel(c.topic, c.message_encoding, schemas[c.schema_id], c.metadata)
            for k, c in sorted(source.channels.items())
        }
        seen = 0
        for m in source.messages(ordered=False):
            data = m.data
            if source.channels[m.channel].topic == topic:
                if seen == number:
                    data = data[: -len(change)] + change
                seen += 1
            writer.add_message(channels[m.channel], m.log_ns, data, m.publish_ns, m.sequence)
        writer.finish()
    assert seen > number
    return to


class Parts(LogBudget):
    """A budget that deletes nothing."""

    def make_room(self, writing: Path | None = None) -> None:
        """Do nothing."""


def logged_again(log: LogWriter, m: LogMessage) -> None:
    """Write a message as it was logged."""
    if m.schema == "kiteline.Blob":
        log.blob(m.topic, m.t_ns, m.blob())
    elif m.topic.endswith("/image"):
        log.image(m.topic, m.t_ns, m.image(), "left")
    elif m.schema == "kiteline.Imu":
        log.imu(m.topic, m.t_ns, m.imu())
    elif m.schema == "kiteline.Fields":
        values = {k: np.array(v) if isinstance(v, list) else v for k, v in m.json().items()}
        log.fields(m.topic, m.t_ns, values)
    elif m.schema.startswith("kiteline."):
        log.json(m.topic, m.t_ns, m.json(), m.schema)


@pytest.mark.parametrize("half", ["agent0", "base"])
def test_a_flight_replays_bit_for_bit(flown: Path, half: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(flown / half / "log.mcap"), "--verify"]) == 0
    assert "every output as in the log" in capsys.readouterr().out


def test_a_flight_with_odometry_replays_bit_for_bit(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    driven = tmp_path / "driven.mcap"
    with LogWriter(driven, {"role": "recording"}) as log:
        done = 0
        for item in (source := open_source(str(recording))):
            assert isinstance(item, Frame)
            if not done:
                log.rig(item.t_ns, source.rig, None)
            n = 3
            stamps = item.t_ns - np.array([40_000_000, 20_000_000, 0], np.int64)
            cov = np.tile(0.02**2 * np.eye(3), (n, 1, 1))
            told = OdometryBatch(stamps, np.tile([STEP_M / PERIOD_S, 0.0, 0.0], (n, 1)), np.zeros((n, 3)), cov, cov)
            log.odometer(ODOMETER, item.t_ns, told)
            log.frame(item)
            done += 1
    report, _ = fly(Options((str(driven),), tmp_path / "out", "local"), quiet=True)
    odometer = dict(report)["agents"][0]["odometer"]  # type: ignore[index]
    assert odometer["trusted"]
    assert odometer["scale"] == pytest.approx(1.0, abs=0.05)
    log_file = tmp_path / "out" / "agent0" / "log.mcap"
    assert main([str(log_file), "--verify"]) == 0
    with LogReader(log_file) as reader:
        assert reader.topics["/odometer"] == done
    # what it says matters: with one variance 65536 times as large the flight is another one
    wrong = rewritten(log_file, tmp_path / "log.mcap", "/odometer", done - 4, b"@")
    capsys.readouterr()
    assert main([str(wrong), "--verify"]) == 1
    assert "the estimate has another" in capsys.readouterr().out


def test_trajectories_of_a_replay_are_those_of_the_flight(flown: Path, tmp_path: Path) -> None:
    assert main([str(flown / "agent0" / "log.mcap"), "--out", str(tmp_path)]) == 0
    for name in ("live.tum", "odometry.tum"):
        assert (tmp_path / name).read_bytes() == (flown / "agent0" / name).read_bytes()


def test_another_packet_in_the_log_is_found(flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = rewritten(flown / "agent0" / "log.mcap", tmp_path / "log.mcap", "/packets/out", 5, b"!")
    assert main([str(log), "--verify"]) == 1
    assert "/packets/out" in capsys.readouterr().out


def test_another_estimate_in_the_log_is_found(flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with LogReader(flown / "agent0" / "log.mcap") as reader:
        fourth = list(reader.messages(["/estimate"]))[4].json()
    assert fourth["T_w_b"] is not None
    log = rewritten(flown / "agent0" / "log.mcap", tmp_path / "log.mcap", "/estimate", 4, struct.pack("<d", 9.0))
    assert main([str(log), "--verify"]) == 1
    assert "T_w_b" in capsys.readouterr().out


def test_a_log_of_another_machine_is_told_and_replayed_to_its_end(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A drone's log at a desk: `differs: step 1` alone seems to say that the replay is broken."""
    with LogReader(flown / "agent0" / "log.mcap") as reader:
        here, steps = reader.metadata["machine"], reader.topics["/step"]
    there = here.replace(here.partition(";")[0], "sparc64", 1)
    log = rewritten(
        flown / "agent0" / "log.mcap", tmp_path / "log.mcap", "/estimate", 4, b"!", {"machine": there}
    )  # fmt: skip
    assert main([str(log), "--verify"]) == 1
    told = capsys.readouterr().out
    assert "the log was made with sparc64, and this is" in told and "odometry is up to 0.0 mm" in told
    with LogReader(log) as reader:
        assert replay_agent(reader, stop_at_first=False).steps == steps


def test_how_far_poses_are_apart() -> None:
    there, here = np.eye(4), np.eye(4)
    here[:3, 3] = 0.03, 0.0, 0.04
    result, logged = ReplayResult(), {"T_o_b": there.ravel().tolist()}
    step = Step(1, {"now_ns": 0}, {"/estimate": [SimpleNamespace(json=lambda: logged)]})
    result.compare_pose(step, "/estimate", "estimate", {"T_o_b": here.ravel().tolist()})
    assert result.apart_m == pytest.approx(0.05) and result.apart_rad == 0.0
    assert result.difference is not None and "T_o_b" in result.difference


def test_a_base_that_heard_something_else_answers_otherwise(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with LogReader(flown / "base" / "log.mcap") as reader:
        sizes = [len(m.data) for m in reader.messages(["/agent0/packets/in"])]
    largest = sizes.index(max(sizes))
    log = rewritten(flown / "base" / "log.mcap", tmp_path / "log.mcap", "/agent0/packets/in", largest, b"!")
    assert main([str(log), "--verify"]) == 1
    assert "differs" in capsys.readouterr().out


def test_a_cut_log_replays_up_to_the_cut_also_when_mended(
    flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "log.mcap"
    whole = (flown / "agent0" / "log.mcap").read_bytes()
    log.write_bytes(whole[: len(whole) // 2])
    assert main([str(log), "--verify"]) == 0
    assert "cut" in capsys.readouterr().out
    assert repair(log) is not None
    assert repair(log) is None
    with LogReader(log) as reader:
        assert reader.cut is None
        assert 5 < replay_agent(reader).steps < 30
    assert main([str(log), "--verify"]) == 0
    assert "cut" in capsys.readouterr().out


def test_the_virtual_cpu_drops_frames(flown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(flown / "agent0" / "log.mcap"), "--cpu", "1", "--virtual"]) == 0
    words = capsys.readouterr().out.split()
    assert int(words[words.index("dropped,") - 1]) > 5
    assert main([str(flown / "agent0" / "log.mcap"), "--cpu", "100", "--virtual"]) == 0
    words = capsys.readouterr().out.split()
    assert words[words.index("dropped,") - 1] == "0"


@pytest.mark.parametrize("half", ["agent0", "base"])
def test_what_no_packet_carried_cannot_be_replayed(recording: Path, tmp_path: Path, half: str) -> None:
    fly(Options((str(recording),), tmp_path, "monolith", seconds=0.3), quiet=True)
    with pytest.raises(SourceError, match="monolith"):
        main([str(tmp_path / half / "log.mcap"), "--verify"])


@pytest.mark.parametrize("half", ["agent0", "base"])
def test_a_log_in_parts_replays_through_all_of_them(
    flown: Path, tmp_path: Path, half: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with LogReader(flown / half / "log.mcap") as reader:
        steps = reader.topics["/step"]
        messages = list(reader.messages())
        budget = Parts(tmp_path, "boot", 2 * sum(len(m.data) for m in messages), 0)  # a part is an eighth
        with LogWriter(tmp_path / "boot00007.mcap", reader.metadata, budget=budget, part_topic="/step") as log:
            for m in messages:
                logged_again(log, m)
    parts = sorted(tmp_path.glob("boot00007_*.mcap"))
    assert len(parts) >= 3
    assert main([str(tmp_path / "boot00007.mcap"), "--verify"]) == 0
    assert capsys.readouterr().out.startswith(f"{steps} steps")
    # what stands in a later part is compared, too
    wrong = rewritten(
        parts[-1], tmp_path / "wrong.mcap", "/packets/out" if half == "agent0" else "/agent0/packets/out", 0, b"!"
    )
    whole = parts[-1].read_bytes()
    wrong.replace(parts[-1])
    assert main([str(tmp_path / "boot00007.mcap"), "--verify"]) == 1
    parts[-1].write_bytes(whole)
    capsys.readouterr()
    parts[1].unlink()
    assert main([str(tmp_path / "boot00007.mcap"), "--verify"]) == 0
    assert "part 2 is missing" in capsys.readouterr().out


@pytest.mark.parametrize("role", ["agent", "base"])
def test_a_later_part_of_a_log_is_no_beginning(tmp_path: Path, role: str) -> None:
    log = LogWriter(tmp_path / "boot00007.mcap", {"role": role}, budget=LogBudget(tmp_path, "boot", 80_000))
    for i in range(3):
        log.blob("/step", i, bytes(9_000))
    log.close()
    with pytest.raises(SourceError, match="part 1 of a log: a replay begins with its first part"):
        main([str(tmp_path / "boot00007_1.mcap"), "--verify"])


@pytest.mark.parametrize(
    ("given", "words"),
    [(["--cpu", "-3"], "--cpu: -3: expected 0"), (["--cpu", "20", "--verify"], "--cpu goes without --verify")],
)
def test_a_limit_that_means_nothing_is_refused(
    given: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["log.mcap", *given])
    assert words in capsys.readouterr().err


def test_a_recording_is_no_log_of_ours(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="fly"):
        main([str(recording), "--verify"])
    cut = tmp_path / "cut.mcap"
    shutil.copy(recording, cut)
    cut.write_bytes(cut.read_bytes()[:100])
    with pytest.raises(SourceError):
        main([str(cut), "--verify"])


def test_a_log_without_its_beginning_is_no_log_that_differs(flown: Path, tmp_path: Path) -> None:
    log, out = flown / "agent0" / "log.mcap", tmp_path / "cut.mcap"
    assert logs.main(["cut", str(log), str(out), "--from", "0.5"]) == 0
    with pytest.raises(SourceError, match=r"begins 0\.5 s after the start"):
        main([str(out), "--verify"])
    first, whole = tmp_path / "first.mcap", tmp_path / "whole.mcap"
    assert logs.main(["cut", str(log), str(first), "--to", "0.499"]) == 0
    assert main([str(first), "--verify"]) == 0
    assert logs.main(["merge", str(whole), str(out), str(first)]) == 0
    with LogReader(whole) as reader:
        check_replayable(reader, "agent")


@pytest.mark.parametrize("words", [["base/log.mcap", "--out", "again"], ["agent0/log.mcap", "--virtual"]])
def test_options_without_effect_are_refused(flown: Path, words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(flown)
    with pytest.raises((SourceError, SystemExit), match=r"base's log|2"):
        main(words)


def test_a_flight_under_a_limit_says_what_was_not_written(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(WholeFile, "write", full_disk)
    assert main([str(flown / "agent0" / "log.mcap"), "--cpu", "50", "--virtual", "--out", str(tmp_path)]) == 0
    assert "poses were not written: " in capsys.readouterr().err


def full_disk(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_log_that_is_not_there_is_told_before_kernels_are_compiled_and_another_is_told_of_them(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    filled: list[tuple[str, ...]] = []
    monkeypatch.setattr("kiteline_lab.replay.replay.kernel_cache.fill", filled.append)
    monkeypatch.setattr("kiteline_lab.replay.replay.agent_warm", lambda: filled.append(("warm",)))
    with pytest.raises((SourceError, FileNotFoundError)):
        main([str(tmp_path / "nowhere.mcap"), "--verify"])
    assert filled == []
    assert main([str(flown / "agent0" / "log.mcap"), "--verify"]) == 0
    assert "kiteline_basestation.runtime.warm" in filled[0] and filled[1] == ("warm",)


def test_a_folder_that_cannot_be_made_is_told_before_the_replay_and_a_flight_is_no_log(
    flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("kiteline_lab.replay.replay.replay_agent", lambda *_, **__: pytest.fail("replayed"))
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        main([str(flown / "agent0" / "log.mcap"), "--out", str(tmp_path / "file" / "again")])
    with pytest.raises(SourceError, match=r"it has none; below it are .*agent0/log\.mcap and .*base/log\.mcap"):
        main([str(flown)])
