"""The status page: snapshots of the station enter; JSON, map messages and the page's files are served to browsers.

    page = serve(*address("127.0.0.1:8080"), lambda: latest)
    ... in the loop that steps the station:
    latest = take_snapshot(station, now_ns, started_ns)

A snapshot is frozen and the server's thread only reads it. A new number on the page is a line in `numbers.py`.
"""

from __future__ import annotations

from kiteline_basestation.web.messages import status
from kiteline_basestation.web.server import Handle, address, serve
from kiteline_basestation.web.snapshot import AgentStatus, PageSnapshot, empty_snapshot, take_snapshot

__all__ = ["AgentStatus", "Handle", "PageSnapshot", "address", "empty_snapshot", "serve", "status", "take_snapshot"]
