"""Kernels of the sparse map: the lists of observations that hang on each point, kept inside flat arrays.

Every keypoint of every keyframe owns one *slot*. `root[s]` is the slot of the point that keypoint s observes (-1 while
unknown). `first[p]` is the newest observation of point p and `next_[s]` the one that follows s in that list (-1: end).
"""

from __future__ import annotations

import numpy as np

from kiteline_core.jit import njit


@njit
def link(slots, roots, root, first, next_):  # type: ignore[no-untyped-def]
    """Let observation slots[i] (n,) int32 hang on point roots[i]; a slot that hangs on another point leaves it."""
    for i in range(slots.shape[0]):
        s = slots[i]
        old = root[s]
        if old >= 0:
            if first[old] == s:
                first[old] = next_[s]
            else:
                k = first[old]
                while k >= 0:
                    if next_[k] == s:
                        next_[k] = next_[s]
                        break
                    k = next_[k]
        root[s] = roots[i]
        next_[s] = -1
        if roots[i] >= 0:
            next_[s] = first[roots[i]]
            first[roots[i]] = s


@njit
def fuse(child, parent, root, first, next_, moved):  # type: ignore[no-untyped-def]
    """Hang all observations of point `child` on point `parent`. Writes the slots that moved; returns how many."""
    n = 0
    s = first[child]
    last = -1
    while s >= 0:
        root[s] = parent
        moved[n] = s
        n += 1
        last = s
        s = next_[s]
    if last >= 0:
        next_[last] = first[parent]
        first[parent] = first[child]
        first[child] = -1
    root[child] = parent
    return n


@njit
def count(points, first, next_):  # type: ignore[no-untyped-def]
    """How many slots hang on the points (n,) together."""
    n = 0
    for i in range(points.shape[0]):
        s = first[points[i]]
        while s >= 0:
            n += 1
            s = next_[s]
    return n


@njit
def gather(points, first, next_, row, usable, keyframe_id, starts, slots):  # type: ignore[no-untyped-def]
    """Observations of points (n,) whose `usable` slot flag is set, as rows starts[i]:starts[i + 1] of slots.

    Within a point they are in order of keyframe id, at most one of each keyframe (the lowest slot). starts: (n + 1,).
    """
    n = 0
    for i in range(points.shape[0]):
        starts[i] = n
        s = first[points[i]]
        while s >= 0:
            if usable[s] != 0:
                key = keyframe_id[row[s]]
                j = n
                same = False
                while j > starts[i]:
                    other = keyframe_id[row[slots[j - 1]]]
                    if other == key:
                        same = True
                        if s < slots[j - 1]:
                            slots[j - 1] = s
                        break
                    if other < key:
                        break
                    j -= 1
                if not same:
                    for k in range(n, j, -1):
                        slots[k] = slots[k - 1]
                    slots[j] = s
                    n += 1
            s = next_[s]
    starts[points.shape[0]] = n
    return n


@njit
def share_keyframe(a, b, first, next_, row, usable):  # type: ignore[no-untyped-def]
    """Whether some keyframe observes both points a and b: then they cannot be one."""
    s = first[a]
    while s >= 0:
        if usable[s] != 0:
            t = first[b]
            while t >= 0:
                if usable[t] != 0 and row[t] == row[s]:
                    return True
                t = next_[t]
        s = next_[s]
    return False


@njit
def covisibility(points, first, next_, row, usable, shared):  # type: ignore[no-untyped-def]
    """Add to shared[k] (keyframes,) how many of the points (n,) keyframe row k observes."""
    for i in range(points.shape[0]):
        s = first[points[i]]
        while s >= 0:
            if usable[s] != 0:
                shared[row[s]] += np.int32(1)
            s = next_[s]
