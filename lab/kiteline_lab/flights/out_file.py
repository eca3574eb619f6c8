"""Files that are either complete or absent: written under another name and renamed at the end."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from kiteline_hw.ports import SourceError


def expect_writable(path: Path) -> None:
    """Raise SourceError if no file of this name can be written: for programs that take long before they write."""
    if path.is_dir() or not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise SourceError(f"{path}: cannot be written: expected a file name in a folder that exists and may be written")


@contextmanager
def whole_file(path: Path, *, force: bool) -> Iterator[Path]:
    """Give a name to write to; the file becomes `path` when the block succeeds, and is removed when it fails.

    Raises SourceError when `path` is there already (unless force), or its folder is not or may not be written.
    """
    if path.exists() and not force:
        raise SourceError(f"{path} exists already: choose another name, or overwrite it with --force")
    expect_writable(path)
    part = path.with_name(f".{path.name}.part")
    try:
        yield part
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
