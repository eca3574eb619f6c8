"""Pixels that past views saw of tracks which are not yet landmarks."""

import numpy as np

from kiteline_core.arrays import F64, I64, Bool


class RayTracks:
    """Observations of each track by each past view."""

    def __init__(self, views: int) -> None:
        self._views = views
        self.ids: I64 = np.zeros(0, np.int64)  # (n,) increasing
        self.xy = np.zeros((0, views, 2))  # x/z, y/z in the view
        self.coarse = np.zeros(0)  # (n,) size of a track's pixels in those of the finest level
        self.seen: Bool = np.zeros((0, views), np.bool_)

    def add(self, view: int, ids: I64, xy: F64, coarse: F64) -> None:
        """Add what the newest view saw. ids: (m,) increasing. xy: (m,2). coarse: (m,)."""
        new = np.setdiff1d(ids, self.ids, assume_unique=True)
        every = np.concatenate([self.ids, new])
        order = np.argsort(every, kind="stable")
        self.ids = every[order]
        self.xy = np.concatenate([self.xy, np.zeros((len(new), self._views, 2))])[order]
        self.seen = np.concatenate([self.seen, np.zeros((len(new), self._views), np.bool_)])[order]
        self.coarse = np.concatenate([self.coarse, np.ones(len(new))])[order]
        at = np.searchsorted(self.ids, ids)
        self.coarse[at] = coarse
        self.xy[at, view] = xy
        self.seen[at, view] = True

    def drop_view(self, view: int) -> None:
        """Forget what a view saw, and tracks that no view saw."""
        self.seen[:, view] = False
        self._keep(np.asarray(self.seen.any(axis=1)))

    def drop(self, ids: I64) -> None:
        """Forget tracks."""
        self._keep(~np.isin(self.ids, ids))

    def keep(self, ids: I64) -> None:
        """Forget all other tracks."""
        self._keep(np.isin(self.ids, ids))

    def find(self, ids: I64) -> tuple[I64, I64]:
        """Places (k,) in `ids` of those that are known, and their rows (k,)."""
        if not len(self.ids):
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        at = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        known = np.flatnonzero(self.ids[at] == ids)
        return known, at[known]

    def _keep(self, keep: Bool) -> None:
        if not keep.all():
            self.ids, self.xy, self.seen = self.ids[keep], self.xy[keep], self.seen[keep]
            self.coarse = self.coarse[keep]
