"""Watches one camera: reports each outage once, with its end; counts gaps in the driver's numbering. No clock."""

STALL_NS = 500_000_000  # ns without a usable image that are an outage: ten frames at 20 Hz
RESTART_NS = 2_000_000_000  # ns without any image after which the device is closed and opened again


class CameraWatch:
    """What a camera did, as messages. Each call returns the line to tell, or None."""

    def __init__(self, name: str, start_ns: int) -> None:
        """start_ns: how long the device may take from its opening to the first image."""
        self._name = name
        self._start_ns = start_ns
        self._begun = False  # an image has come since the device was opened
        self._good_ns: int | None = None  # last usable image
        self._any_ns = 0  # last image of any kind, or the last opening
        self._since_ns: int | None = None  # beginning of the outage that was told
        self._said = ""
        self._bad = ""  # why the last image was unusable
        self._sequence: int | None = None
        self.missing = 0  # images that the driver numbered and did not deliver

    def opened(self, now_ns: int) -> None:
        """The device was opened: its numbering begins anew."""
        self._any_ns, self._sequence, self._begun = now_ns, None, False
        if self._good_ns is None:
            self._good_ns = now_ns

    def image(self, now_ns: int, sequence: int | None) -> str | None:
        """A usable image came."""
        if sequence is not None:
            if self._sequence is not None and sequence > self._sequence + 1:
                self.missing += sequence - self._sequence - 1
            self._sequence = sequence
        self._good_ns = self._any_ns = now_ns
        self._begun = True
        self._bad = ""
        if self._since_ns is None:
            return None
        away_s = (now_ns - self._since_ns) / 1e9
        self._since_ns, self._said = None, ""
        return f"camera {self._name}: images again after {away_s:.1f} s"

    def bad_image(self, now_ns: int, why: str) -> str | None:
        """An image came that cannot be used."""
        self._any_ns, self._bad, self._begun = now_ns, why, True
        return self.check(now_ns)

    def failed(self, now_ns: int, text: str) -> str | None:
        """The device is gone or cannot be opened. text: with the mend."""
        return self._say(now_ns, text, f"{text}; it is tried again and again")

    def check(self, now_ns: int) -> str | None:
        """Time passes without an image."""
        if self._good_ns is None or now_ns - self._good_ns < STALL_NS:
            return None
        if self._bad:
            return self._say(
                self._good_ns, "bad",
                f"camera {self._name} sends images that cannot be used ({self._bad}): check its cable and settings",
            )  # fmt: skip
        if now_ns - self._any_ns < (STALL_NS if self._begun else self._start_ns):
            return None
        return self._say(
            self._good_ns,
            "silent",
            f"camera {self._name} sends no images: check its cable, and its trigger if it has one",
        )

    def needs_restart(self, now_ns: int) -> bool:
        """True if the device has been silent for so long that it should be opened again."""
        return now_ns - self._any_ns >= (RESTART_NS if self._begun else self._start_ns)

    @property
    def well(self) -> bool:
        """True if images come."""
        return self._since_ns is None and self._good_ns is not None

    def _say(self, since_ns: int, what: str, line: str) -> str | None:
        """One line for each outage; a further one only if the camera vanishes during it."""
        if self._since_ns is None:
            self._since_ns = since_ns
        elif what == self._said or what in ("bad", "silent"):
            return None
        if self._said.startswith("camera") and what.startswith("camera"):
            return None  # absent is absent, whichever error the driver gives meanwhile
        self._said = what
        return line
