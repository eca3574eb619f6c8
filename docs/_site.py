"""Hooks of `make docs`: pages that lie outside of docs/ or are made from the code, and links to them."""

import contextlib
import io
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
# Page of the site for each Markdown file outside of docs/.
OUTSIDE = {
    "README.md": "index.md",
    "ARCHITECTURE.md": "explanation/architecture.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "codec/SPEC.md": "reference/messages.md",
}
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]+)((?:#[^)]*)?)\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are not files in docs/."""
    for source, page in OUTSIDE.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    files.append(File.generated(config, "reference/commands.md", content=commands_page()))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turn links between files of the repository into links between pages; those to code into plain text."""
    here = page.file.src_uri
    source = next((s for s, p in OUTSIDE.items() if p == here), f"docs/{here}")

    def rewritten(match: re.Match[str]) -> str:
        image, text, target, anchor = match.groups()
        if "://" in target:
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if path in OUTSIDE:
            path = f"docs/{OUTSIDE[path]}"
        if not path.startswith("docs/"):
            return text
        return f"{image}[{text}]({posixpath.relpath(path[5:], posixpath.dirname(here) or '.')}{anchor})"

    return LINK.sub(rewritten, markdown)


def commands_page() -> str:
    """`--help` of every command."""
    from kiteline_cli import main as cli

    lines = ["# Commands", "", "What `kiteline COMMAND --help` prints.", ""]
    for title, group in cli.find_commands().items():
        lines += [f"## {title}", ""]
        for command in group:
            text = io.StringIO()
            arguments = ["eval", "--help"] if command.name == "grid" else ["--help"]
            with contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
                cli.main([command.name, *arguments])
            examples = "\n".join(command.load().EXAMPLES)
            body = text.getvalue().split("\nexamples:\n")[0].strip()
            lines += [f"### kiteline {command.name}", "", command.load().SUMMARY.capitalize() + ".", ""]
            lines += ["```", examples, "```", "", "```text", body, "```", ""]
    return "\n".join(lines)
