"""Chooses the profile of a link, and the pause between two keyframes. Pure."""

from dataclasses import replace

from kiteline_codec.pacing.profiles import RADIO, WIFI, Profile

_THIN_BYTES_S = 6_000  # below it, keyframes of the wide profile would come every second at best
_WIDE_BYTES_S = 15_000  # above it, two a second
_PATIENCE_NS = 3_000_000_000  # ns that a link must stay thin, or wide, before the profile changes
_LASTING_NS = 60_000_000_000  # ns; a wide profile that lasted less is tried again later each time
_MAX_CAUTION = 16
_LIVE_BYTES = 38  # of a live pose in a packet, which it mostly shares
_MAX_LIVE_GAP_NS = 750_000_000  # ns; one pose a second arrives, a little late or early
_MIN_DESCRIBED = 7  # described landmarks of a keyframe: one section
_MAX_GAP_NS = 5_000_000_000  # ns; beyond it keyframes would not overlap
_SECOND_NS = 1_000_000_000


class Pacer:
    """Chooses the profile if none is given, and the pause between keyframes."""

    def __init__(self, profile: Profile | None, budget_bytes: int | None) -> None:
        """budget_bytes: on the wire in any second, None if unlimited."""
        self._fixed = profile is not None or budget_bytes is not None
        self._budget_bytes = budget_bytes
        thin = budget_bytes is not None and budget_bytes < _THIN_BYTES_S
        self.profile = profile or (RADIO if thin else WIFI)
        self._other_since_ns: int | None = None  # since when the other profile would suit
        self._widened_ns: int | None = None  # when the wide profile was tried again
        self._caution = 1  # times the patience before it is tried again
        self._keyframe_t_ns: int | None = None
        self._interval_ns = _SECOND_NS  # between keyframes, smoothed

    def step(self, measured_bytes_s: int | None, now_ns: int) -> None:
        """Change the profile if the link asks for it. measured_bytes_s: throughput, None while nothing has to wait."""
        if self._fixed:
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
            self._caution = min(2 * self._caution, _MAX_CAUTION) if soon else 1
            self.profile, self._other_since_ns = RADIO, None
        elif self.profile is RADIO and now_ns - self._other_since_ns >= 4 * self._caution * _PATIENCE_NS:
            self._widened_ns = now_ns
            self.profile, self._other_since_ns = WIFI, None

    def keyframe(self, t_ns: int) -> None:
        """Note the time of a keyframe."""
        if self._keyframe_t_ns is not None and t_ns > self._keyframe_t_ns:
            interval_ns = min(t_ns - self._keyframe_t_ns, _MAX_GAP_NS)
            self._interval_ns += (interval_ns - self._interval_ns) // 4
        self._keyframe_t_ns = t_ns

    def share(self, measured_bytes_s: int | None) -> Profile:
        """The profile; on a thin link, with no more landmarks than it carries at the present rate of keyframes."""
        rate = self._budget_bytes or measured_bytes_s
        p = self.profile
        if not rate or not p.thin:
            return p
        room = rate * self._interval_ns // _SECOND_NS - p.observations_room_bytes
        described = max(_MIN_DESCRIBED, min(room // (3 * p.landmark_bytes), p.described))
        undescribed = max(0, room - described * p.landmark_bytes) // p.undescribed_bytes
        landmarks = min(described + undescribed, p.landmarks)
        left = room - described * p.landmark_bytes - (landmarks - described) * p.undescribed_bytes
        described += max(0, left) // (p.landmark_bytes - p.undescribed_bytes)
        return replace(p, described=min(described, landmarks, p.described), landmarks=landmarks)

    @property
    def live_gap_ns(self) -> int:
        """Time between two live poses: the profile's, but at most a fifth of a budget, and one a second."""
        if self._budget_bytes is None:
            return self.profile.live_gap_ns
        fair_ns = _LIVE_BYTES * 5 * _SECOND_NS // self._budget_bytes
        return max(self.profile.live_gap_ns, min(fair_ns, _MAX_LIVE_GAP_NS))

    def keyframe_gap_ns(self, backlog_bytes: int, measured_bytes_s: int | None) -> int:
        """Time between two keyframes of which the second is not urgent. backlog_bytes: still to be sent."""
        rate = self._budget_bytes or measured_bytes_s
        if not rate:
            return 0
        need = max(self.profile.keyframe_bytes, backlog_bytes)
        return min(need * _SECOND_NS // rate, _MAX_GAP_NS)
