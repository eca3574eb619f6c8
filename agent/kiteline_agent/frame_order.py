"""Frames in order of time: what the trackers assume, whoever steps them."""

from kiteline_core.frame import Frame


class FrameOrder:
    """Leaves out frames that are not newer than the newest one. left_out: how many."""

    def __init__(self) -> None:
        self.left_out = 0
        self._newest_ns: int | None = None
        self._in_turn = 0  # left out since the newest one

    def newer(self, frame: Frame | None) -> tuple[Frame | None, list[str]]:
        """The frame, or None in place of one that is not newer, and events: as this begins and when it is over."""
        if frame is None:
            return None, []
        newest_ns = self._newest_ns
        if newest_ns is None or frame.t_ns > newest_ns:
            left_out, self._newest_ns, self._in_turn = self._in_turn, frame.t_ns, 0
            return frame, [f"stamps increase again; frames left out: {left_out}"] if left_out else []
        self.left_out += 1
        self._in_turn += 1
        if self._in_turn > 1:
            return None, []
        return None, [f"frame left out: its stamp {frame.t_ns} ns is not after {newest_ns} ns"]
