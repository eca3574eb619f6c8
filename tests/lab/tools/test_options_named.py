"""Every option is varied or read by a test or a benchmark, or a page that people wrote tells of it."""

import re
from functools import cache
from operator import attrgetter
from pathlib import Path

from kiteline_lab.tools.options import ROOTS, Option, sections

ROOT = Path(__file__).parents[3]
MADE = {"reference/configuration.md", "results.md"}  # pages that no hand wrote
_SET_OR_READ = re.compile(r"\w+(?=\s*=(?!=))|(?<=[\"'.])\w+")  # `name=`, `.name`, "name"


@cache
def code() -> tuple[tuple[frozenset[str], frozenset[str]], ...]:
    """Of each test and benchmark: all its words, and those that it sets or reads."""
    texts = [path.read_text(encoding="utf-8") for room in ("tests", "bench") for path in (ROOT / room).rglob("*.py")]
    return tuple((frozenset(re.findall(r"\w+", text)), frozenset(_SET_OR_READ.findall(text))) for text in texts)


@cache
def pages() -> str:
    """All pages that people wrote, one after the other."""
    docs = ROOT / "docs"
    written = [path for path in docs.rglob("*.md") if path.relative_to(docs).as_posix() not in MADE]
    return "\n".join(path.read_text(encoding="utf-8") for path in [*written, ROOT / "README.md"])


def is_named(option: Option) -> bool:
    """Code counts where it names the section, too: by its class, or by the last part of its name."""
    root, *path = option.section.split(".")
    section = attrgetter(".".join(path))(ROOTS[root]) if path else ROOTS[root]
    last = option.section.rpartition(".")[2]
    names = {type(section).__name__, last}
    if any(option.key in used and names & words for words, used in code()):
        return True
    return re.search(rf"`{option.key}\b|\b{last}\.{option.key}\b|^{option.key} = ", pages(), re.M) is not None


def test_every_option_is_named_in_a_test_a_benchmark_or_a_page() -> None:
    assert [o.name for section in sections() for o in section.options if not is_named(o)] == []
