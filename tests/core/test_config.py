import tomllib
from dataclasses import dataclass, field
from enum import Enum
from typing import ClassVar, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_core.config import ConfigError, apply, describe, load, of_log


class Mode(Enum):
    FAST = "fast"
    FINE = "fine"


@dataclass(frozen=True, slots=True)
class Tracker:
    points: int = 300
    sigma_px: float = 1.0
    mono: bool = False
    mode: Mode = Mode.FAST
    levels: tuple[int, ...] = (1, 2, 4)
    window: tuple[float, float] = (0.5, 2.0)
    name: str = "flow"
    limit: float | None = None
    kind: Literal["a", "b"] = "a"

    def __post_init__(self) -> None:
        if self.points < 1:
            raise ValueError("points: at least 1 is needed")


@dataclass(frozen=True, slots=True)
class Inner:
    tracker: Tracker = field(default_factory=Tracker)
    gain: float = 0.5


@dataclass(frozen=True, slots=True)
class Config:
    MAY_BE_ZERO: ClassVar = ("rate_hz",)

    rate_hz: float = 20.0
    inner: Inner = field(default_factory=Inner)


def test_a_table_overrides_nested_values_and_leaves_the_rest() -> None:
    table = {"rate_hz": 30, "inner": {"tracker": {"points": 100, "mode": "fine", "levels": [8], "limit": 2}}}
    out = apply(Config(), table)
    assert out == Config(30.0, Inner(Tracker(points=100, mode=Mode.FINE, levels=(8,), limit=2.0)))
    assert isinstance(out.rate_hz, float)
    assert out.inner.gain == 0.5
    assert Config() == Config(20.0)  # the original is untouched


@pytest.mark.parametrize(
    ("value", "words"), [("0", "above 0"), ("-1", "not negative"), ("nan", "finite"), ("inf", "finite")]
)
def test_numbers_out_of_range_are_refused_in_files(value: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load(Config(), f"[agent.inner]\ngain = {value}\n", "agent", "rig.toml")
    assert apply(Config(), {"inner": {"gain": 0.0}}).inner.gain == 0.0  # code may: it knows what it does


def test_a_section_says_which_numbers_may_be_zero() -> None:
    assert load(Config(), "[agent]\nrate_hz = 0\n", "agent", "rig.toml").rate_hz == 0.0


def test_unknown_key_names_key_section_and_what_is_known() -> None:
    with pytest.raises(ConfigError) as caught:
        apply(Config(), {"inner": {"tracker": {"point": 3}}})
    text = str(caught.value)
    assert "did you mean inner.tracker.points?" in text
    assert "'point'" in text
    assert "[inner.tracker]" in text
    assert "points, sigma_px" in text


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"rate_hz": "fast"}, ["rate_hz", "'fast'", "a number"]),
        ({"rate_hz": True}, ["rate_hz", "True", "a number"]),
        ({"rate_hz": 10**400}, ["rate_hz", "a number"]),
        ({"inner": {"tracker": {"points": 10**400}}}, ["inner.tracker.points", "a whole number"]),
        ({"inner": 3}, ["[inner]", "section"]),
        ({"inner": {"tracker": {"points": 1.5}}}, ["inner.tracker.points", "a whole number"]),
        ({"inner": {"tracker": {"mono": 1}}}, ["mono", "true or false"]),
        ({"inner": {"tracker": {"mode": "slow"}}}, ["mode", "'fast', 'fine'"]),
        ({"inner": {"tracker": {"levels": [1, "x"]}}}, ["levels[1]", "a whole number"]),
        ({"inner": {"tracker": {"window": [1.0]}}}, ["window", "a list of 2"]),
        ({"inner": {"tracker": {"limit": "no"}}}, ["limit", "a number"]),
        ({"inner": {"tracker": {"kind": "c"}}}, ["kind", "'a', 'b'"]),
        ({"inner": {"tracker": {"points": 0}}}, ["[inner.tracker]", "at least 1"]),
    ],
)
def test_wrong_values_are_told_apart(table: dict[str, object], words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        apply(Config(), table)
    assert all(word in str(caught.value) for word in words), str(caught.value)


@given(
    points=st.integers(1, 10**9),
    sigma=st.floats(allow_nan=False, allow_infinity=False),
    name=st.text(),
    levels=st.lists(st.integers(-(2**62), 2**62)),
    mode=st.sampled_from(Mode),
)
def test_description_parses_back_to_the_same_config(
    points: int, sigma: float, name: str, levels: list[int], mode: Mode
) -> None:
    config = Config(sigma, Inner(Tracker(points, sigma, True, mode, tuple(levels), name=name)))
    assert apply(Config(), tomllib.loads(describe(config))) == config


def test_description_reads_as_sections() -> None:
    text = describe(Config())
    assert text.startswith("rate_hz = 20.0\n")
    assert "[inner]\ngain = 0.5\n" in text
    assert "[inner.tracker]\npoints = 300\n" in text
    assert "# limit is not set" in text


def test_the_log_of_another_build_is_told_from_a_wrong_file() -> None:
    assert of_log(Config(), describe(Config(9.0))) == Config(9.0)
    with pytest.raises(ConfigError, match=r"another build wrote this log \(unknown key 'points'.*kiteline fly LOG"):
        of_log(Config(), "points = 3")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[agent]\n# \xff\n", "not a text file"),
        (b"gain = " + b"9" * 5000, "a number too long"),
        (b"gain = " + b"[" * 100_000, "tables too deep"),
        (b"gain = " + b"{a=" * 5000, "tables too deep"),
        (b".".join([b"a"] * 200) + b" = 1", "tables in each other"),
        (b".".join([b"a"] * 100_000) + b" = 1", "dots in a name"),
        (b"# long\n" * 200_000, "longer than 1 MiB"),
        (b"\0" * 100, "no valid TOML"),
        (b"a = 1\na = 2\n", "no valid TOML"),
    ],
)
def test_a_file_of_any_content_is_refused_by_name(content: bytes, words: str) -> None:
    with pytest.raises(ConfigError, match=f"mine.toml: .*{words}"):
        load(Config(), content, "agent", "mine.toml")
