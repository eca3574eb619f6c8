"""Finds how far all disparities are off, from landmarks that two frames see from different places.

The parallax between the frames tells depths up to one scale. A disparity offset is not a scale: disparities of near and
far landmarks, and of different parts of the image, contradict it. Each keyframe counts once, with the later frame that
tells most: disparities of one keyframe have the same errors in all frames.

A worn rig gets the estimate of a wide prior once it is sure to be worn. A good calibration is off by a tenth of a pixel
all the same, 3 % of lengths at 20 m: unless the rig is worn, it has the most probable offset under the prior of good
calibrations, about what earlier flights found, from the first pair on.
"""

import math

import numpy as np

from kiteline_agent.config import DisparityAlignmentConfig
from kiteline_agent.local_map import disparity_kernels as kernels
from kiteline_agent.local_map.local_map import LocalMap
from kiteline_agent.local_map.offset_evidence import Prior, probability
from kiteline_core.arrays import F64, I64
from kiteline_core.geometry import se3
from kiteline_core.geometry.disparity_offset import GOOD_PX, TERMS, none, terms
from kiteline_core.ids import NO_KEYFRAME
from kiteline_core.order_statistics import median

_LEAST_RHO = 1e-4  # 1/m
_LEAST_PARALLAX = 0.02  # distance over depth of a first pair, but for _PARALLAX_GROWTH
_MIN_POINTS = 30  # landmarks of a pair; eleven numbers are estimated from them
_USUAL_SQUARE = 0.45  # mean squared error above which a pair counts less before an offset is applied
_KNOWN_PX = 0.1  # px; by which each number of an offset changes between two flights: mounts and temperature
_PRIOR_PX = 0.9  # px; standard deviation of a constant offset of a worn rig: both centres moved
_PRIOR_SLOPE_RAD = 1.1e-3  # rad; the same of the other terms: a right camera that is turned by 0.06 degrees
_BENT, _BENT_LOG_ODDS = 8.0, -4.0  # times these of a mount that was bent by a degree; one worn rig in fifty is
_LEAST_CHANGE_PX = 0.04  # px, rms over the image; of a later change of a worn rig's offset that is applied
_LEAST_GOOD_CHANGE_PX = 0.015  # the same of a good calibration's: depths follow, and the base is told
_ROWS_SURE = 0.99  # probability of a worn rig by rows alone, above which its offset is applied in any motion
_INFLATION = 2.0  # factor on variances: templates and lens errors are common to neighbouring points
_ITERATIONS = 3  # Gauss-Newton steps; two converge from a scale that is off by a tenth
_REFUTED = 5.0  # log likelihood without earlier flights over that with them, from which those are dropped
_LEAST_PX = 0.2  # px, rms over the image; of a first offset of a worn rig: good calibrations have a tenth
_MIN_SIDEWAYS = 0.2  # share of the motion across the optical axis below which errors of a lens pass for such
_FORWARD_SHARE = 1.0 / 9.0  # of the information about a worn rig that is believed then: errors were three deviations
_FORWARD_KEYFRAMES = 12  # that tell something of their own then; more of them repeat errors of lens and tracks
_FORWARD_GOOD_KEYFRAMES = 3  # the same of a good calibration's offset, which is no larger than these errors are
_PAIR_EVERY_S = 0.18  # s between two pairs, at most: slow cameras, and frames that the governor skips
_PARALLAX_GROWTH = 1.2  # of the parallax between two pairs of the same keyframe
_WORN_SHARE = 0.2  # probability of a worn rig before the flight
_DIAGONAL = np.diag_indices(kernels.UNKNOWNS)
_SURE = 0.95  # probability of a worn rig above which the offset is applied


class DisparityAlignment:
    """Information about the offset, by keyframe; and the offset that is applied."""

    def __init__(self, local_map: LocalMap, config: DisparityAlignmentConfig) -> None:
        self._map, self._config = local_map, config
        camera = local_map.camera
        slots = len(local_map.keyframe)
        self._keyframe = np.full(slots, NO_KEYFRAME, np.int64)  # whose pairs these are
        self._parallax = np.zeros(slots)  # of the last pair of each keyframe
        self._score = np.zeros(slots)  # of its best pair: minus the sum of the offset's variances over the image
        self._moved = np.zeros((slots, 3))  # m, translation of the best pair in the camera, squared
        # Information about the offset, and its product with the estimate: of the best pair of each keyframe, of
        # keyframes that were evicted, and of earlier flights.
        self._pair_h, self._pair_b = np.zeros((slots, TERMS, TERMS)), np.zeros((slots, TERMS))
        self._evicted_h, self._evicted_b, self._evicted_moved = np.zeros((TERMS, TERMS)), np.zeros(TERMS), np.zeros(3)
        self._evicted = 0  # keyframes
        self._earlier_h, self._earlier_b = np.zeros((TERMS, TERMS)), np.zeros(TERMS)
        # Share of a pair's information that counts before an offset is applied; and what counted of those evicted.
        self._share = np.ones(slots)
        self._evicted_sure_h, self._evicted_sure_b = np.zeros((TERMS, TERMS)), np.zeros(TERMS)
        self._refuted = False  # earlier flights were of another rig; the map still has their offset
        self._prior = Prior(np.diag(np.array([_PRIOR_PX, *[_PRIOR_SLOPE_RAD * camera.fx] * (TERMS - 1)]) ** -2.0))
        self._bent = Prior(self._prior.information / _BENT**2)
        x, y = np.meshgrid(np.linspace(0.0, camera.width, 7), np.linspace(0.0, camera.height, 5))
        self._grid = terms(np.stack([(x.ravel() - camera.cx) / camera.fx, (y.ravel() - camera.cy) / camera.fy], 1))
        # A good calibration is as good at the edges of a wide view.
        self._good = Prior(np.diag((np.maximum(np.abs(self._grid).max(axis=0), 1.0) / GOOD_PX) ** 2))
        self._frames = 0  # since the last one that could make a pair
        self._pair_t_ns: int | None = None  # of that one
        self.pairs = 0  # compared so far
        self._estimate, self.cov = none(), np.linalg.inv(self._prior.information)
        # If the rig is not worn: what was expected of it, its most probable offset, and the information about that.
        self.expected_px, self._good_estimate, self._good_h = none(), none(), np.zeros((TERMS, TERMS))
        self._prior_log_odds = math.log(_WORN_SHARE / (1.0 - _WORN_SHARE))  # of a worn rig
        self._log_odds = self._prior_log_odds  # by disparities alone
        self.worn = self.rig_worn = _WORN_SHARE  # probability of it: by disparities alone, and with rows
        self._row_evidence = 0.0  # see add_row_evidence
        self.applied = False  # the rig is worn: an offset found here was applied
        self._applied_sigma_px = np.inf  # of the estimate that was applied
        self.is_good_offset = False  # the map's offset is a good calibration's, found here
        self._follows_good = False  # it is, or it is none since that is near enough
        self._base_sigma_px: float | None = None  # of the map's offset, if the base found it; inf for a good rig's
        self.expected_cov = self._expected_cov()  # beside the error of a good calibration
        self._events: list[str] = []

    def begin_with(self, offset: F64, sigma_px: float) -> None:
        """Begin with the offset (5,) that earlier flights found, which the map has already.

        sigma_px: its standard deviation, rms over the image.
        """
        of_each = sigma_px / float(np.sqrt(np.mean(np.sum(self._grid**2, axis=1))))  # number, if all have the same
        self._earlier_h = np.eye(TERMS) / (_KNOWN_PX**2 + of_each**2)
        self._earlier_b = self._earlier_h @ offset
        self._solve()
        self.applied = bool(offset.any())
        self.expected_cov = self._expected_cov()

    def add(self, t_ns: int, T_c_m: F64, rows: I64, observed: F64) -> F64 | None:
        """Add a frame of t_ns at T_c_m (4,4) with landmarks in rows (n,) seen at observed (n,3) px.

        Returns the change (5,) of the map's offset if there is one.
        """
        config, m = self._config, self._map
        self._frames += 1
        if self._pair_t_ns is None:
            self._pair_t_ns = t_ns
        if self._frames < config.every and t_ns - self._pair_t_ns < _PAIR_EVERY_S * 1e9:
            return None
        self._frames, self._pair_t_ns = 0, t_ns
        slots = (np.bincount(rows // m.slot_size) >= _MIN_POINTS).nonzero()[0].tolist()
        for k in slots:
            if self._keyframe[k] != m.keyframe[k]:
                self._begin(k)
        parallaxes = {k: self._parallax_of(k, T_c_m) for k in slots}
        growth = {k: now / max(float(self._parallax[k]), _LEAST_PARALLAX) for k, now in parallaxes.items()}
        slot = max(growth, key=lambda s: growth[s], default=None)
        if slot is None or growth[slot] < _PARALLAX_GROWTH:
            return None
        if self._add_pair(slot, T_c_m, rows, observed, parallaxes[slot]):
            self._solve()
            change = self._apply()
            self.expected_cov = self._expected_cov()
            return change
        return None

    def add_row_evidence(self, log_likelihood: float) -> None:
        """Set the logarithm of the likelihood of the right camera's rows with a worn rig over that with a good one."""
        if log_likelihood != self._row_evidence:
            self._row_evidence = log_likelihood
            self._set_rig_worn()
            self.expected_cov = self._expected_cov()

    @property
    def good_information(self) -> F64:
        """(5,5) 1/px^2, on which the map's offset rests if it is a good calibration's; zero for any other."""
        return self._good_h if self._follows_good else np.zeros((TERMS, TERMS))

    @property
    def sigma_px(self) -> float:
        """Standard deviation of the estimate, rms over the image."""
        return self._rms_px(np.asarray(self.cov))

    @property
    def applied_sigma_px(self) -> float | None:
        """Standard deviation of the map's offset, rms over the image; None if it may be a good calibration's."""
        base = self._base_sigma_px
        if base is not None:
            return base if np.isfinite(base) else None
        return self.sigma_px if self.applied else None

    def moves_map(self, change: F64) -> bool:
        """True if keyframes and camera move by the effect of a change (5,) px of the offset.

        Not by the small ones of a good calibration: their effect on poses is less than what it is known to.
        """
        return self.applied or self.voids_turns(change)

    def voids_turns(self, change: F64) -> bool:
        """True if rotations by images, as they were before a change (5,) px of the offset, do not refute an IMU."""
        return self._size_px(change) >= _LEAST_PX

    def take_base(self, offset: F64, sigma_px: float | None) -> bool:
        """Set the map's offset to the base's (5,), unless more is known here. Returns whether it was set.

        sigma_px: its standard deviation, rms over the image; None while the base takes the rig for well calibrated.
        """
        if self.applied and (sigma_px is None or sigma_px > self.sigma_px):
            return False
        self._base_sigma_px = np.inf if sigma_px is None else sigma_px
        self.is_good_offset = self._follows_good = False
        if not (self._pair_h.any() or self._evicted_h.any()):
            self.expected_px = np.array(offset)  # of earlier flights: what this one tells would count twice
        self._map.set_disparity_offset(offset)
        self._map.held.offsets.base_knows_all()
        self.expected_cov = self._expected_cov()
        return True

    def take_events(self) -> list[str]:
        """Changes since the last call, for the log."""
        events, self._events = self._events, []
        return events

    def _begin(self, slot: int) -> None:
        """A new keyframe took this slot: keep the information of the one before, which was evicted."""
        self._evicted_h += self._pair_h[slot]
        self._evicted_b += self._pair_b[slot]
        self._evicted_sure_h += self._share[slot] * self._pair_h[slot]
        self._evicted_sure_b += self._share[slot] * self._pair_b[slot]
        self._evicted_moved += self._moved[slot]
        self._evicted += int(self._score[slot] != 0.0)
        self._pair_h[slot], self._pair_b[slot], self._moved[slot] = 0.0, 0.0, 0.0
        self._keyframe[slot], self._parallax[slot], self._score[slot] = self._map.keyframe[slot], 0.0, 0.0

    def _parallax_of(self, slot: int, T_c_m: F64) -> float:
        """Distance from a keyframe over the depth of its landmarks."""
        T = T_c_m @ self._map.T_m_k[slot]
        usable = self._map.usable[slot]
        return float(np.linalg.norm(T[:3, 3]) * median(self._map.rho[slot, usable])) if usable.any() else 0.0

    def _add_pair(self, slot: int, T_c_m: F64, rows: I64, observed: F64, parallax: float) -> bool:
        """Compare a frame with a keyframe. True if the pair has more information than earlier ones of that keyframe."""
        config, m = self._config, self._map
        at = np.flatnonzero(rows // m.slot_size == slot)
        index = rows[at] % m.slot_size
        measured = m.disparity[slot, index] > 0.0
        at, index = at[measured], index[measured]
        if len(at) < _MIN_POINTS:
            return False
        if len(at) > config.points:
            chosen = np.linspace(0, len(at) - 1, config.points).astype(np.int64)
            at, index = at[chosen], index[chosen]
        self.pairs += 1
        self._parallax[slot] = parallax
        seen = observed[at].copy()
        has = seen[:, 2] >= 0.0
        seen[has, 2] += m.offset_px(seen[has, :2])
        uv, disparity = m.uv[slot, index], m.disparity[slot, index]
        sigma = config.sigma_px * (1 << m.octave[rows[at]]).astype(np.float64)
        T, offset, prior = T_c_m @ m.T_m_k[slot], self._estimate.copy(), self._prior.information
        rho = np.maximum((disparity - terms(m.bearing[slot, index]) @ offset) / m.camera.bf, _LEAST_RHO)
        system, point = np.empty((kernels.UNKNOWNS, kernels.UNKNOWNS + 1)), np.empty((len(at), kernels.UNKNOWNS + 1))
        for _ in range(_ITERATIONS):
            kernels.linearise_pair(uv, disparity, sigma, seen, T, m.intrinsics, offset, rho, system, point)
            h, b = system[:, :-1].copy(), system[:, -1].copy()
            h[6:, 6:] += prior
            b[6:] -= prior @ offset
            h[_DIAGONAL] += 1e-9
            step: F64 = np.asarray(np.linalg.solve(h, b), np.float64)
            kernels.move_points(point, step, _LEAST_RHO, rho)
            X = se3.exp(np.concatenate([np.zeros(3), step[3:6]]))
            T = X @ T
            T[:3, 3] += step[:3]
            offset = offset + step[6:]
        square = kernels.linearise_pair(uv, disparity, sigma, seen, T, m.intrinsics, offset, rho, system, point)
        to_pose = np.linalg.solve(system[:6, :6] + 1e-6 * np.eye(6), system[:6, 6:]).T
        scale = _INFLATION * max(square, 1.0)
        information = (system[6:, 6:-1] - to_pose[:TERMS] @ system[:6, 6:-1]) / scale
        side = (system[6:, -1] - to_pose[:TERMS] @ system[:6, -1]) / scale + information @ offset
        score = -float(np.trace(self._grid @ np.linalg.solve(information + prior, self._grid.T)))
        if not np.isfinite(score) or (self._score[slot] != 0.0 and score <= self._score[slot]):
            return False
        self._score[slot], self._pair_h[slot], self._pair_b[slot] = score, information, side
        self._share[slot] = max(square, 1.0) / max(square / _USUAL_SQUARE, 1.0)
        self._moved[slot] = (T[:3, :3].T @ T[:3, 3]) ** 2
        return True

    def _solve(self) -> None:
        """Estimate the offset, and the probability that the rig is worn, by the Bayes factor.

        What earlier flights found is dropped if the flight is likelier without it: the rig was repaired.
        """
        h, b = self._evicted_h + self._pair_h.sum(0), self._evicted_b + self._pair_b.sum(0)
        own = self._own_share(_FORWARD_GOOD_KEYFRAMES)
        self._solve_good(own * h, own * b)
        own = self._own_share(_FORWARD_KEYFRAMES)
        h, b = own * h, own * b
        if self._is_bent():
            self._prior = self._bent
        log_odds = self._prior_log_odds
        if self._earlier_h.any() and self._moves_sideways():
            worn, usual = self._prior.log_evidence(h, b), self._good.log_evidence(h, b)
            unknown = np.logaddexp(log_odds + worn, usual) - np.logaddexp(log_odds, 0.0)
            earlier = Prior(self._prior.information + self._earlier_h, self._earlier_b)
            if unknown - earlier.log_evidence(h, b) > _REFUTED:
                self._earlier_h, self._earlier_b = np.zeros_like(self._earlier_h), none()
                self._refuted, self.applied = True, False
                self._events.append("disparities are not those of the rig file: estimated anew")
        share = self._believed_share()
        h, b = share * h + self._earlier_h, share * b + self._earlier_b
        self.cov = np.linalg.inv(h + self._prior.information)
        self._estimate = self.cov @ b
        log_odds += self._prior.log_evidence(h, b) - self._good.log_evidence(h, b)
        self._log_odds = float(log_odds)
        self.worn = probability(self._log_odds)
        self._set_rig_worn()

    def _solve_good(self, h: F64, b: F64) -> None:
        """Estimate the offset if the calibration is good: about the expected one, from information h (5,5), b (5,)."""
        self._good_estimate = self.expected_px + np.linalg.solve(h + self._good.information, b - h @ self.expected_px)
        self._good_h = h

    def _is_sure(self) -> bool:
        """True if the rig is worn though pairs tell less whose landmarks fit badly: some may be on people who walk.
        In forward motion, where disparities tell little, the rows of the right image count as well.
        """
        rows = 0.0 if self._moves_sideways() else self._row_evidence
        if probability(self._log_odds + rows) < _SURE:
            return False
        share = self._own_share(_FORWARD_KEYFRAMES) * self._believed_share()
        h, b = self._sure()
        h, b = share * h + self._earlier_h, share * b + self._earlier_b
        odds = self._prior_log_odds + self._prior.log_evidence(h, b) - self._good.log_evidence(h, b)
        return probability(odds + rows) >= _SURE

    def _sure(self) -> tuple[F64, F64]:
        """Information (5,5) of all pairs and its side (5,), less of those whose landmarks fit badly."""
        h = self._evicted_sure_h + np.einsum("s,sij->ij", self._share, self._pair_h)
        return h, self._evicted_sure_b + self._share @ self._pair_b

    def _is_bent(self) -> bool:
        """True if an offset beyond wear is likelier: the mount was bent by up to a degree or two."""
        if not self._moves_sideways():
            return False
        h, b = self._sure()
        gain = self._bent.log_evidence(h, b) - self._prior.log_evidence(h, b)
        return gain + _BENT_LOG_ODDS > 0.0

    def _own_share(self, most: int) -> float:
        """Share of the pairs' information, if in forward motion no more than so many keyframes tell on their own."""
        return 1.0 if self._moves_sideways() else min(1.0, most / max(self._keyframes, 1))

    @property
    def _keyframes(self) -> int:
        """Number of keyframes that told something."""
        return self._evicted + int(np.count_nonzero(self._score))

    def _believed_share(self) -> float:
        """Share of the pairs' information that counts where a worn rig is told from a good one."""
        return 1.0 if self._moves_sideways() else _FORWARD_SHARE

    def _nothing_better_known(self) -> bool:
        """True if neither earlier flights nor sideways motion told an offset that forward motion may not replace."""
        return not self._earlier_h.any() and self.sigma_px <= self._applied_sigma_px

    def _set_rig_worn(self) -> None:
        self.rig_worn = probability(self._log_odds + self._row_evidence)

    def _moves_sideways(self) -> bool:
        """True if enough of the motion was across the optical axis: else errors of a lens pass for an offset."""
        moved = self._evicted_moved + self._moved.sum(0)
        return bool(moved[:2].sum() >= _MIN_SIDEWAYS * moved.sum())

    def _expected_cov(self) -> F64:
        """(5,5) px^2: mean square of what the map's offset is off by, beside the error of a good calibration."""
        offset = self._map.disparity_offset
        known = offset.any() and not self.is_good_offset
        left = none() if known and self._base_sigma_px is not None else self._estimate - offset
        return np.asarray((1.0 if known else self.rig_worn) * (self.cov + np.outer(left, left)))

    def _apply(self) -> F64 | None:
        """Change the offset of the map's disparities, unless the base's estimate is more certain."""
        if self._base_sigma_px is not None and self._base_sigma_px <= self.sigma_px:
            return None
        tells = self._moves_sideways() or self._rows_are_worn()
        if (tells and self.applied) or ((tells or self._nothing_better_known()) and self._is_sure()):
            return self._apply_worn()
        # Forward motion hardly tells a worn rig from a good one: until then the good one's offset is the better guess.
        doubtful = self.rig_worn > 0.5 if tells else self._refuted
        worn = self.applied or self._earlier_h.any() or np.isfinite(self._base_sigma_px or np.inf)
        self._follows_good = not (worn or doubtful)
        return self._apply_good() if self._follows_good else None

    def _rows_are_worn(self) -> bool:
        """True if the rows of the right camera alone tell that the rig is worn."""
        return probability(self._prior_log_odds + self._row_evidence) >= _ROWS_SURE

    def _apply_worn(self) -> F64 | None:
        """Set the offset of a rig that is sure to be worn."""
        found_here = self.applied or self._refuted or self.is_good_offset
        change = self._set(self._estimate, _LEAST_CHANGE_PX if found_here else _LEAST_PX)
        if change is not None:
            self.applied, self._base_sigma_px = True, None
            self._refuted = self.is_good_offset = self._follows_good = False
            self._applied_sigma_px = self.sigma_px
            self._events.append(f"disparities in the middle are {self._estimate[0]:+.2f} px too large, by parallax")
        return change

    def _apply_good(self) -> F64 | None:
        """Set the most probable offset of a good calibration."""
        change = self._set(self._good_estimate, _LEAST_GOOD_CHANGE_PX)
        if change is not None:
            self.is_good_offset, self._refuted, self._base_sigma_px = True, False, None
        return change

    def _size_px(self, offset: F64) -> float:
        """Rms over the image of an offset (5,)."""
        return float(np.sqrt(np.mean((self._grid @ offset) ** 2)))

    def _rms_px(self, square: F64) -> float:
        """Root of the mean over the image of an offset's square, told as the mean square (5,5) of its terms."""
        return float(np.sqrt(np.mean(np.einsum("ni,ij,nj->n", self._grid, square, self._grid))))

    def _set(self, offset: F64, least_px: float) -> F64 | None:
        """Set the map's offset (5,); the change, None if it is less than least_px, rms over the image."""
        change = offset - self._map.disparity_offset
        if self._size_px(change) < least_px:
            return None
        self._map.set_disparity_offset(offset)
        return np.asarray(change)
