"""Which profile suits a link, and how long to wait between two keyframes. Pure."""

from __future__ import annotations

from dataclasses import replace

from kiteline_codec.pacing.profiles import RADIO, WIFI, Profile

_THIN_BYTES_S = 6_000  # below it, keyframes of the wide profile would come every second at best
_WIDE_BYTES_S = 15_000  # above it, two a second
_PATIENCE_NS = 3_000_000_000  # ns that a link must look thin, or wide, before the profile changes
_LASTING_NS = 60_000_000_000  # ns; a wide profile that was given up sooner is tried again later each time
_MOST_CAUTION = 16
_LIVE_BYTES = 45  # of a live pose in a packet
_LONGEST_LIVE_GAP_NS = 750_000_000  # ns; one a second arrives, a little late or early
_LEAST_DESCRIBED = 7  # births of a keyframe: one section
_LONGEST_GAP_NS = 5_000_000_000  # ns; beyond it a map would come apart


class Pacer:
    """Chooses the profile where none is given, and the pause between keyframes."""

    def __init__(self, profile: Profile | None, budget_bytes: int) -> None:
        self._fixed = profile is not None
        self._budget_bytes = budget_bytes
        thin = 0 < budget_bytes < _THIN_BYTES_S
        self.profile = profile or (RADIO if thin else WIFI)
        self._other_since_ns: int | None = None
        self._widened_ns: int | None = None  # when the wide profile was tried again
        self._caution = 1  # times the patience before it is tried again
        self._keyframe_t_ns: int | None = None
        self._interval_ns = 1_000_000_000  # between keyframes, smoothed

    def step(self, measured_bytes_s: int | None, now_ns: int) -> None:
        """Look at the link once in a while. measured_bytes_s: None while nothing has to wait."""
        if self._fixed or self._budget_bytes:
            return
        if self.profile is WIFI:
            change = measured_bytes_s is not None and measured_bytes_s < _THIN_BYTES_S
        else:
            change = measured_bytes_s is None or measured_bytes_s > _WIDE_BYTES_S
        if not change:
            self._other_since_ns = None
        elif self._other_since_ns is None:
            self._other_since_ns = now_ns
        elif self.profile is WIFI and now_ns - self._other_since_ns >= _PATIENCE_NS:
            soon = self._widened_ns is not None and now_ns - self._widened_ns < _LASTING_NS
            self._caution = min(2 * self._caution, _MOST_CAUTION) if soon else 1
            self.profile, self._other_since_ns = RADIO, None
        elif self.profile is RADIO and now_ns - self._other_since_ns >= 4 * self._caution * _PATIENCE_NS:
            self._widened_ns = now_ns
            self.profile, self._other_since_ns = WIFI, None

    def keyframe(self, t_ns: int) -> None:
        """A keyframe was made at a time."""
        if self._keyframe_t_ns is not None and t_ns > self._keyframe_t_ns:
            interval_ns = min(t_ns - self._keyframe_t_ns, _LONGEST_GAP_NS)
            self._interval_ns += (interval_ns - self._interval_ns) // 4
        self._keyframe_t_ns = t_ns

    def share(self, measured_bytes_s: int | None) -> Profile:
        """The profile, with no more births than the link carries at the pace at which keyframes come."""
        rate = self._budget_bytes or measured_bytes_s
        if not rate or not self.profile.thin:
            return self.profile
        room = rate * self._interval_ns // 1_000_000_000 - self.profile.sightings_room_bytes
        p = self.profile
        described = max(_LEAST_DESCRIBED, min(room // (3 * p.birth_bytes), p.described))
        blank = max(0, room - described * p.birth_bytes) // p.blank_bytes
        return replace(p, described=described, births=min(described + blank, p.births))

    @property
    def live_gap_ns(self) -> int:
        """Between two live poses: what the profile says, but no more than a fifth of a budget, and one a second."""
        if not self._budget_bytes:
            return self.profile.live_gap_ns
        fair_ns = _LIVE_BYTES * 5 * 1_000_000_000 // self._budget_bytes
        return max(self.profile.live_gap_ns, min(fair_ns, _LONGEST_LIVE_GAP_NS))

    def keyframe_gap_ns(self, backlog_bytes: int, measured_bytes_s: int | None) -> int:
        """How long a keyframe that is not pressing waits after the one before. backlog_bytes: still to be sent."""
        rate = self._budget_bytes or measured_bytes_s
        if not rate:
            return 0
        need = max(self.profile.keyframe_bytes, backlog_bytes)
        return min(need * 1_000_000_000 // rate, _LONGEST_GAP_NS)
