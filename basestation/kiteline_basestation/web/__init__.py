"""The base's status page: what every agent does, and the map from above, in a browser.

    page = serve(*address("127.0.0.1:8080"), lambda: latest)
    ... once or twice a second, in the loop that steps the station:
    if page.watched:
        latest = overview(station, now_ns, started_ns)
    ... at the end:
    page.close()

`latest` starts as `nothing(now_ns)`. A snapshot is frozen, and the page's own thread only reads it: the mapper never
waits, and while nobody looks nothing is computed.
"""

from __future__ import annotations

from kiteline_basestation.web.page_snapshot import AgentView, Snapshot, status
from kiteline_basestation.web.server import Handle, address, serve
from kiteline_basestation.web.take_snapshot import nothing, overview

__all__ = ["AgentView", "Handle", "Snapshot", "address", "nothing", "overview", "serve", "status"]
