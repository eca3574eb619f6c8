import re
import resource
import tomllib
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest

from kiteline_agent.config import AgentConfig
from kiteline_agent.runtime.options import agent_config
from kiteline_basestation.config import BaseConfig
from kiteline_basestation.runtime.options import base_config
from kiteline_core.config import ConfigError, apply
from kiteline_lab.tools import config as command
from kiteline_lab.tools.options import as_markdown, as_toml, sections

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "configuration.md"


def count(config: object) -> int:
    values = [getattr(config, f.name) for f in fields(config) if f.init]  # type: ignore[arg-type]
    return sum(count(v) if is_dataclass(v) else 1 for v in values)


def test_the_printed_configuration_is_the_default_and_complete() -> None:
    table = tomllib.loads(as_toml())
    assert apply(AgentConfig(), table["agent"], "agent") == AgentConfig()
    assert apply(BaseConfig(), table["base"], "base") == BaseConfig()
    options = [o for s in sections() for o in s.options]
    assert len({o.name for o in options}) == len(options) == count(AgentConfig()) + count(BaseConfig())


def test_options_have_units_and_all_a_reason() -> None:
    by_name = {o.name: o for s in sections() for o in s.options}
    assert by_name["agent.smoothing.max_m_s"].unit == "m/s"
    assert by_name["agent.keyframe.max_gap_s"].unit == "s"
    assert by_name["base.grid.cell_m"].reason.startswith("a quarter of the gap")
    assert all(s.purpose for s in sections())
    assert by_name["base.measurement.sigma_disparity_px"].reason.startswith("at octave 0; ")  # in brackets
    assert [o.name for o in by_name.values() if not o.reason] == []


@pytest.mark.skipif(not Path("/dev/zero").exists(), reason="needs /dev/zero")
def test_a_file_that_never_ends_is_refused() -> None:
    readers: list[Callable[[], object]] = [
        lambda: agent_config("/dev/zero"), lambda: base_config("/dev/zero"),
        lambda: agent_config("", rig="/dev/zero"), lambda: command.main(["--check", "/dev/zero"]),
    ]  # fmt: skip
    limit = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, limit[1]))  # else a reader without an end takes all memory
    try:
        for read in readers[:3]:
            with pytest.raises(ConfigError, match="longer than 1 MiB"):
                read()
        assert readers[3]() == 2
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limit)


def test_the_reference_page_is_up_to_date() -> None:
    assert PAGE.read_text(encoding="utf-8") == as_markdown(), f"run: kiteline config --markdown > {PAGE}"


def test_a_check_names_line_and_expectation_of_every_problem(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(
        '[agent.keyframe]\nmin_shar = 0.5\nmax_gap_s = "3"\nmin_cover = -1.0\n\n[agen.x]\ny = 1\n'
        "[base]\ngraph.max_full = 1.5\n[base.gird]\ncell_m = 0.2\n[agent]\nstereo = 1\n"
    )
    assert command.main(["--check", str(path)]) == 2
    lines = capsys.readouterr().err.splitlines()
    expected = [
        ("line 2:", "did you mean agent.keyframe.min_share?"),
        ("line 3:", "expected a number"),
        ("line 4:", "not negative"),
        ("line 13:", "[agent.stereo] is a section"),
        ("line 6:", "unknown table [agen]"),
        ("line 9:", "expected a whole number"),
        ("line 11:", "did you mean base.grid"),
    ]
    assert len(lines) == len(expected)
    for line, parts in zip(sorted(lines), sorted(expected), strict=True):
        assert all(part in line for part in parts), (line, parts)
    with pytest.raises(ConfigError):
        agent_config(str(path))


def test_nothing_stands_for_a_number_only_where_the_reason_says_what_that_means() -> None:
    numbers = [
        o for s in sections() for o in s.options
        if isinstance(o.default, int | float) and not isinstance(o.default, bool) and o.default > 0
    ]  # fmt: skip
    assert len(numbers) > 200
    for o in numbers:
        problems = command.check(f"[{o.section}]\n{o.key} = 0\n")
        assert bool(problems) == (re.search(r"\b0: ", o.reason) is None or "octave 0: " in o.reason), o
        assert all("expected" in p.text for p in problems), problems


def test_each_switch_can_be_turned_over_in_a_file(tmp_path: Path) -> None:
    switches = [o for s in sections() for o in s.options if isinstance(o.default, bool)]
    assert {o.name for o in switches} > {"agent.scan.on", "agent.disparities.on"}
    for option in switches:
        section, name = option.name.rsplit(".", 1)
        file = tmp_path / "options.toml"
        file.write_text(f"[{section}]\n{name} = {'false' if option.default else 'true'}\n")
        read = agent_config if section.startswith("agent") else base_config
        assert read(str(file)) != read("")
        assert command.main(["--check", str(file)]) == 0


@pytest.mark.parametrize(
    "text",
    [
        "[agent.pyramid]\nlevels = 1", "[agent.pyramid]\nlevels = 40", "[agent.ground]\ndisparities = 40",
        "[agent.ground]\ndisparities = 480", "[agent.ground]\ncolumns = 1", "[agent.ground]\ncolumns = 640",
    ],
)  # fmt: skip
def test_numbers_with_which_no_frame_can_be_processed_are_refused(text: str) -> None:
    (problem,) = command.check(text)
    assert "expected" in problem.text


def test_reasons_do_not_repeat_the_unit_and_name_values_as_toml_has_them() -> None:
    options = [o for s in sections() for o in s.options]
    assert [o for o in options if o.unit and o.reason.startswith(f"{o.unit} ")] == []
    assert [o for o in options if re.search("True|False", o.reason)] == []
    assert next(o for o in options if o.name == "agent.stereo.sigma_px").reason.startswith("at octave 0: ")


@pytest.mark.parametrize("text", ["a = = 1\n", "[agent\n"])
def test_text_that_is_no_toml_is_a_problem_with_its_line(text: str) -> None:
    (problem,) = command.check(text)
    assert problem.line == 1
    assert "no valid TOML" in problem.text


def test_a_root_that_is_no_section_is_a_problem() -> None:
    assert [p.line for p in command.check("agent = 3\nbase = []\n")] == [1, 2]


def test_a_sound_file_passes_and_its_changes_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "rig.toml"
    path.write_text("[agent.keyframe]\nmax_gap_s = 2\nmin_share = 0.65\n[base]\n")
    assert command.main(["--check", str(path)]) == 0
    assert "no problem found" in capsys.readouterr().out
    assert command.main(["--changed", str(path)]) == 0
    assert capsys.readouterr().out == "agent.keyframe.max_gap_s = 2  # default 3.0 s\n"


def test_explaining_a_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--explain", "keyframe.max_gap_s"]) == 0
    text = capsys.readouterr().out
    assert "[agent.keyframe]" in text
    assert "max_gap_s = 3.0 s  (a number)" in text
    assert command.main(["--explain", "grid"]) == 0
    assert "cell_m = 0.05 m" in capsys.readouterr().out
    assert command.main(["--explain", "keyframe.max_gap_sec"]) == 2
    assert "did you mean agent.keyframe.max_gap_s?" in capsys.readouterr().err
