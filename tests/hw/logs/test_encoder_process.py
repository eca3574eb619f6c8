"""Images encoded in another process: the same pixels, in order, also when that process ends before its time."""

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from kiteline_core.arrays import U8
from kiteline_core.frame import Frame
from kiteline_hw.logs import encoder_process
from kiteline_hw.logs.encoder_process import EncoderProcess
from kiteline_hw.logs.image_encoder import EncodingPolicy, ImageEncoder
from kiteline_hw.logs.mcap_log import LEFT, RIGHT, LogReader, LogWriter
from kiteline_hw.sensors.images import decode_grey, encode_image


def picture(seed: int, shape: tuple[int, int] = (48, 75)) -> U8:
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


def test_the_same_bytes_as_here_and_slots_are_used_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encoder_process, "END_S", 60.0)  # a busy machine runs it late: it is nice
    apart = EncoderProcess((48, 75), 3)
    for k in range(10):
        done = apart.submit(picture(k))
        apart.wait(done)
        assert done.result() == encode_image(picture(k))
    waiting = [apart.submit(picture(k)) for k in range(3)]
    assert all(waiting)
    assert apart.submit(picture(0, (480, 752))) is None  # larger than a slot
    for k, done in enumerate(waiting):
        apart.wait(done)
        assert np.array_equal(decode_grey(done.result())[0], picture(k))
    smaller = apart.submit(picture(7, (20, 30)))
    apart.wait(smaller)
    assert np.array_equal(decode_grey(smaller.result())[0], picture(7, (20, 30)))
    apart.close()
    assert apart._process.returncode == 0


def test_no_slot_is_free_and_nobody_waits() -> None:
    apart = EncoderProcess((48, 75), 2)
    os.kill(apart._process.pid, signal.SIGSTOP)
    assert apart.submit(picture(0)) and apart.submit(picture(1))
    begin_s = time.monotonic()
    assert apart.submit(picture(2)) is None
    assert time.monotonic() - begin_s < 0.2
    os.kill(apart._process.pid, signal.SIGCONT)
    apart.close()


@pytest.mark.parametrize("kill_at", [None, 0, 4])
def test_a_log_is_whole_whenever_the_process_ends(tmp_path: Path, kill_at: int | None) -> None:
    encoder = ImageEncoder(EncodingPolicy(most_waiting=6))
    encoder.stores = encoder.apart = True
    with LogWriter(tmp_path / "log.mcap", {}, encoder=encoder) as log:
        for k in range(10):
            log.json("/step", k, {"k": k})
            log.frame(Frame(k, picture(k), picture(100 + k)))
            log.blob("/packets", k, b"%d" % k)
            if k == kill_at:
                process = encoder._process
                process._process.kill()
            if k % 3 == 2:
                time.sleep(0.1)
    with LogReader(tmp_path / "log.mcap") as read:
        found = list(read.messages())
    assert [m.topic for m in found] == ["/step", LEFT, RIGHT, "/packets"] * 10
    for k in range(10):
        left, right = (decode_grey(m.image())[0] for m in found[4 * k + 1 : 4 * k + 3])
        assert np.array_equal(left, picture(k)) and np.array_equal(right, picture(100 + k))


@pytest.mark.alone
def test_a_pair_costs_this_process_little(tmp_path: Path) -> None:
    """Beside a copy of it, less than a tenth of encoding it here, more than a pair that came encoded.

    By turns and all at one pace: some machines make memory slow that rests for some tens of ms.
    """
    random = np.random.default_rng(0)
    frames = [random.integers(0, 16, (2, 480, 752), np.uint8) for _ in range(4)]
    encoded = [tuple(encode_image(image) for image in pair) for pair in frames]
    source, copy = random.integers(0, 16, (4, 2, 480, 752), np.uint8), np.zeros((2, 480, 752), np.uint8)

    def writer(log: LogWriter, raw: bool) -> Callable[[int], object]:
        def write(k: int) -> None:
            pair = frames[k % 4]
            log.frame(Frame(k, pair[0], pair[1], None, () if raw else encoded[k % 4]))
            log.blob("/packets", k, b"")

        return write

    encoder = ImageEncoder(EncodingPolicy())
    encoder.stores = encoder.apart = True
    with LogWriter(tmp_path / "raw.mcap", {}, encoder=encoder) as raw, LogWriter(tmp_path / "encoded.mcap", {}) as log:
        tried: list[tuple[Callable[[int], object], list[int]]] = [
            (writer(raw, True), []),
            (writer(log, False), []),
            (lambda k: [encode_image(image) for image in frames[k % 4]], []),
            (lambda k: np.copyto(copy, source[k % 4]), []),
        ]
        for k in range(25):
            for take, spent in tried:
                begin_ns = time.process_time_ns()
                take(k)
                spent.append(time.process_time_ns() - begin_ns)
                time.sleep(0.03)  # the other process encodes meanwhile
        assert encoder._process is not None and encoder._process.alive and not encoder.stored
    # Of the cheaper ones: what else runs on the machine only adds.
    raw_ms, encoded_ms, encoding_ms, copy_ms = (np.percentile(spent[5:], 25) / 1e6 for _, spent in tried)
    assert raw_ms - encoded_ms < 0.1 * encoding_ms + copy_ms


@pytest.mark.parametrize("silence_s", [0.3, 60.0])
def test_a_log_is_whole_and_ends_where_the_process_does_not_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, silence_s: float
) -> None:
    """Nothing was written after the image that it had, all of it waited in memory, and the log did not end."""
    monkeypatch.setattr(encoder_process, "_SILENCE_S", silence_s)
    monkeypatch.setattr(encoder_process, "END_S", 0.5)
    encoder = ImageEncoder(EncodingPolicy(most_waiting=6))
    encoder.stores = encoder.apart = True
    log = LogWriter(tmp_path / "log.mcap", {}, encoder=encoder)
    log.frame(Frame(0, picture(0), picture(100)))
    log.flush()
    os.kill(encoder._process._process.pid, signal.SIGSTOP)
    begin_s = time.monotonic()
    for k in range(1, 30):
        log.frame(Frame(k, picture(k), picture(100 + k)))
        time.sleep(0.03)
    log.blob("/packets", 30, b"last")
    assert encoder._process.alive == (silence_s == 60.0)  # with 60 s, it is found at the end
    log.close()
    assert time.monotonic() - begin_s < 5.0
    with LogReader(tmp_path / "log.mcap") as read:
        images = [(m.t_ns, decode_grey(m.image())[0]) for m in read.messages((LEFT,))]
        assert [m.blob() for m in read.messages(("/packets",))] == [b"last"]
    assert [t_ns for t_ns, _ in images] == list(range(30))
    assert all(np.array_equal(pixels, picture(t_ns)) for t_ns, pixels in images)
