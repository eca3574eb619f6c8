"""The base's status page: what every agent does, and the map from above, in a browser.

handle = serve("127.0.0.1", 8080, snapshot)   # snapshot() -> Snapshot, see view.py; called from the page's own thread
handle.url, handle.close()

Nothing is computed while nobody looks. `snapshot` must be quick and safe to call from another thread: let the mapper's
loop put a finished, frozen Snapshot into a variable, and return that.
"""

from __future__ import annotations

from kiteline_basestation.web.server import Handle, address, serve
from kiteline_basestation.web.view import AgentView, Snapshot, status

__all__ = ["AgentView", "Handle", "Snapshot", "address", "serve", "status"]
