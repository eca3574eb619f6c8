"""The documentation: links lead somewhere, files that it names exist, and no page is forgotten."""

import pkgutil
import re
from pathlib import Path

import pytest
import yaml

from kiteline_bench.benchmark import parts
from kiteline_cli.main import find_commands

ROOT = Path(__file__).parents[2]
ROOMS = ("core", "codec", "hw", "agent", "basestation", "lab", "bench", "cli", "docs", "tests", "examples", "systemd")
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), ROOT / "codec" / "SPEC.md"])
COMMANDS = "reference/commands.md"  # a page that docs/_site.py makes of the code; the next ones are files elsewhere
MADE = {COMMANDS, "reference/messages.md", "index.md", "contributing.md", "changelog.md", "explanation/architecture.md"}


def text_of(page: Path) -> str:
    return re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """Anchors of the headings, as GitHub and mkdocs make them."""
    headings = re.findall(r"^#+ (.*)$", text_of(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]*))?\)", text_of(page)):
        if "://" in target:
            continue
        path = (page.parent / target).resolve() if target else page
        if path.is_relative_to(ROOT / "docs") and str(path.relative_to(ROOT / "docs")) == COMMANDS:
            continue
        assert path.exists(), f"{page.name}: {target}"
        assert not anchor or anchor in anchors(path), f"{page.name}: {target}#{anchor}"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_files_that_are_named_exist(page: Path) -> None:
    named = re.findall(rf"`((?:{'|'.join(ROOMS)})/[\w./-]+)`", text_of(page))
    missing = [name for name in named if not (ROOT / name).exists() and "NAME" not in name]
    assert not missing, f"{page.name} names what does not exist: {missing}"


@pytest.mark.parametrize("page", ["ARCHITECTURE.md", "CONTRIBUTING.md"])
def test_names_of_the_code_are_in_the_code(page: str) -> None:
    """A table, class, function or field that a recipe names; for `Class.method` both in one file."""
    files = [
        set(re.findall(r"\w+", p.read_text(encoding="utf-8"))) for room in ROOMS for p in ROOT.glob(f"{room}/**/*.py")
    ]
    named = set(re.findall(r"`(_?[A-Za-z]\w*(?:\.[a-z_]\w*)*)(?:\([^`]*\))?`", text_of(ROOT / page)))
    named -= {name for name in named if name.endswith((".md", ".py", ".toml", ".json", ".tum"))}
    missing = [name for name in named if not any(set(name.split(".")) <= words for words in files)]
    assert len(named) > 40
    assert not missing, f"{page} names what no source holds: {missing}"


def test_names_in_other_pages_are_in_the_code_too() -> None:
    """A class, function, field, option or module; what stands in capitals may be a flight controller's."""
    files = [p for room in ROOMS for p in ROOT.glob(f"{room}/**/*") if p.suffix in (".py", ".env", ".service", ".js")]
    texts = "\n".join(p.read_text(encoding="utf-8") for p in files)
    known = (
        set(re.findall(r"\w+", texts))
        | {p.stem for p in files}
        | {"linuxpy", "pyv4l2", "v4l2py", "oom", "activating", "R_a_b"}
    )
    for page in sorted({*ROOT.glob("docs/**/*.md")} - {ROOT / "docs/results.md"}):
        named = set(re.findall(r"`(_?[A-Za-z]\w*(?:\.[A-Za-z_]\w*)*)(?:\([^`]*\))?`", text_of(page)))
        named = {
            name
            for name in named
            if not re.fullmatch("[A-Z0-9_x]+", name) and not name.endswith((".tum", ".msg", ".hpp"))
        }
        missing = [name for name in named if not set(name.removesuffix(".py").split(".")) <= known]
        assert not missing, f"{page.name} names what no source holds: {missing}"


def test_options_of_commands_that_are_named_exist() -> None:
    rooms = ("agent", "basestation", "lab", "bench", "cli")
    texts = "\n".join(p.read_text(encoding="utf-8") for room in rooms for p in ROOT.glob(f"{room}/**/*.py"))
    known = set(re.findall(r'"(--[a-z][a-z-]*)"', texts))
    for page in PAGES:
        for line in re.findall(r"^.*\bkiteline [a-z-]+ .*$", page.read_text(encoding="utf-8"), re.MULTILINE):
            for command in re.findall(r"\bkiteline [a-z][a-z-]* [^`#;|]*", line):
                missing = set(re.findall(r"(?<=\s)--[a-z][a-z-]+", command)) - known
                assert not missing or page.name == "results.md", f"{page.name}: {command}: {missing}"


def test_commands_that_are_named_exist() -> None:
    commands = {c.name for group in find_commands().values() for c in group}
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        blocks = "".join(re.findall(r"^```(?!text).*?^```", text, re.DOTALL | re.MULTILINE))
        for name in re.findall(r"`kiteline ([a-z][a-z-]*)", text) + re.findall(
            r"^kiteline ([a-z][a-z-]*)", blocks, re.MULTILINE
        ):
            assert name in commands | {"hello"}, f"{page.name}: kiteline {name}"
        if page.name != "results.md":
            for name in re.findall(r"`kiteline bench ([a-z/-]+)", text):
                assert parts(name), f"{page.name}: kiteline bench {name}"


def test_every_page_is_in_the_navigation() -> None:
    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))

    def pages(entry: object) -> list[str]:
        if isinstance(entry, dict):
            return [p for value in entry.values() for p in pages(value)]
        return [p for value in entry for p in pages(value)] if isinstance(entry, list) else [str(entry)]

    listed = set(pages(config["nav"]))
    present = {str(p.relative_to(ROOT / "docs")) for p in (ROOT / "docs").glob("**/*.md")} | MADE
    decisions = {p for p in present if p.startswith("decisions/") and p != "decisions/README.md"}
    assert listed == present - decisions
    index = (ROOT / "docs/decisions/README.md").read_text(encoding="utf-8")
    assert all(f"]({Path(p).name})" in index for p in decisions)


@pytest.mark.parametrize("room", ["core", "codec", "hw", "agent", "basestation", "lab", "bench"])
def test_the_architecture_names_every_subpackage(room: str) -> None:
    rows = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8").splitlines()
    (row,) = (line for line in rows if line.startswith(f"| `{room}` |"))
    outside_brackets = re.sub(r"\([^)]*\)", "", row.split("|")[2])
    packages = {p.parent.name for p in (ROOT / room).glob("kiteline_*/*/__init__.py")}
    assert set(re.findall(r"`(\w+)`", outside_brackets)) == packages


@pytest.mark.parametrize(
    ("module", "heading"),
    [("agent/kiteline_agent/agent.py", "**Agent.**"), ("basestation/kiteline_basestation/mapper.py", "**Base.**")],
)
def test_the_architecture_has_the_numbered_steps_of_the_code(module: str, heading: str) -> None:
    steps = re.findall(r"^ *# (\d\. .*)$", (ROOT / module).read_text(encoding="utf-8"), re.MULTILINE)
    assert [int(step[0]) for step in steps] == list(range(1, len(steps) + 1))
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8").partition(heading)[2]
    listed = re.findall(r"^(\d\. (?:.*\n)(?: {3}.*\n)*)", text.partition("\n**")[0], re.MULTILINE)
    written = [" ".join(item.split()) for item in listed]
    assert len(written) == len(steps) > 5
    for item, step in zip(written, steps, strict=True):
        assert item.startswith(step.rstrip(".")), (item, step)


def test_api_pages_name_modules_and_objects_that_exist() -> None:
    names = [
        n for p in (ROOT / "docs/reference/api").glob("*.md") for n in re.findall(r"^::: (\S+)$", p.read_text(), re.M)
    ]
    assert len(names) > 10
    for name in names:
        pkgutil.resolve_name(name)


def test_every_glossary_entry_is_a_sentence_with_its_place_in_the_code() -> None:
    rows = [line for line in (ROOT / "docs/glossary.md").read_text().splitlines() if line.startswith("| **")]
    assert len(rows) > 60
    for row in rows:
        term, meaning, place = (cell.strip() for cell in row.strip("|").split("|"))
        assert meaning.endswith("."), term
        named = re.fullmatch(r"`([\w./-]+)`", place)
        assert named, term
        for name in re.findall(r"`(\w+)`", term):
            assert re.search(rf"^class {name}\b", (ROOT / named[1]).read_text(), re.MULTILINE), (
                f"{name} is not in {named[1]}"
            )


def test_each_bar_that_is_not_met_is_explained() -> None:
    """A benchmark with such a bar is named on their page, and no other one is."""
    unmet = set(
        re.findall(r"\| `kiteline bench (\S+)` \| \*\*\d+ of \d+\*\* \|", (ROOT / "docs/results.md").read_text())
    )
    page = (ROOT / "docs/explanation/unmet-bars.md").read_text()
    assert set(re.findall(r"`kiteline bench (\S+)`", page)) == unmet
