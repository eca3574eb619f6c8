import io
import time

import pytest

from kiteline_lab.flights.progress import Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_file_gets_whole_lines_and_few_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    out = io.StringIO()
    with Progress("flying", 100, "frames", out) as p:
        for i in range(1, 101):
            now[0] = 0.12 * i  # 12 s in all
            p.update(i, "3 keyframes")
    lines = out.getvalue().splitlines()
    assert len(lines) == 3  # two on the way, one at the end
    assert lines[0].startswith("flying: 42/100 frames  7 s left")
    assert lines[-1] == "flying: 100/100 frames  12.0 s  3 keyframes"
    assert "\r" not in out.getvalue()


def test_the_time_before_the_first_unit_is_no_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    out = io.StringIO()
    with Progress("flying", 100, "frames", out) as p:
        now[0] = 20.0  # kernels are loaded
        p.update(1)
        now[0] = 21.0
        p.update(11)
        now[0] = 25.0
        p.update(51)
    first, later, _ = out.getvalue().splitlines()
    assert first == "flying: 1/100 frames"
    assert later.startswith("flying: 51/100 frames  5 s left")


def test_a_terminal_gets_one_line_redrawn() -> None:
    out = Terminal()
    with Progress("reading", 4, "images", out) as p:
        p.update(2)
    text = out.getvalue()
    assert text.startswith("\rreading ██████████████░")
    assert text.count("\n") == 1
    assert text.endswith("\n")


def test_an_unknown_total_is_a_plain_count() -> None:
    out = Terminal()
    with Progress("live", None, "frames", out) as p:
        p.update(7)
    assert "7 frames" in out.getvalue()
    assert "/" not in out.getvalue()
