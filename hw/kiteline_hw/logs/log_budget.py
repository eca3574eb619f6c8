"""Limits what the logs of all starts take on disk: the oldest are deleted before a new one begins."""

from __future__ import annotations

from pathlib import Path


def make_room(folder: Path, stem: str, cap_bytes: int) -> int:
    """Delete the oldest logs `STEM*.mcap` until half of the cap is free; the bytes that the next log may take.

    Nothing else in the folder is touched. A file that cannot be deleted counts as used.
    """
    logs = []
    for path in folder.glob(f"{stem}*.mcap"):
        digits = path.stem.removeprefix(stem).replace("_", "")
        if digits.isdecimal():
            status = path.stat()
            logs.append((status.st_mtime_ns, path, status.st_size))
    used = sum(size for _, _, size in logs)
    for _, path, size in sorted(logs):
        if used <= cap_bytes // 2:
            break
        try:
            path.unlink()
            used -= size
        except OSError:
            continue
    return max(0, cap_bytes - used)
