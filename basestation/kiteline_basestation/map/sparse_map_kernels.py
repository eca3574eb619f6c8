"""Kernels of the sparse map: a linked list of observations for each landmark, inside flat arrays.

Each keypoint has one slot. `root[s]`: slot of the landmark that keypoint s observes, -1 unknown. `first[p]`: newest
observation of landmark p. `next_[s]`: observation after s in the list, -1 at its end.
"""

import numpy as np

from kiteline_core.jit import njit


@njit
def link(slots, roots, root, first, next_):  # type: ignore[no-untyped-def]
    """Make slots[i] (n,) int32 observations of landmarks roots[i] (-1: of none), and no longer of any other."""
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
    """Move all observations of landmark `child` to `parent`. Writes their slots to `moved`; returns their number."""
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
def count(landmarks, first, next_):  # type: ignore[no-untyped-def]
    """Total number of observations of landmarks (n,), valid or not."""
    n = 0
    for i in range(landmarks.shape[0]):
        s = first[landmarks[i]]
        while s >= 0:
            n += 1
            s = next_[s]
    return n


@njit
def gather(landmarks, first, next_, row, usable, keyframe_id, starts, slots):  # type: ignore[no-untyped-def]
    """Write the usable observations of landmarks (n,): those of landmark i to slots[starts[i]:starts[i + 1]].

    They are in order of keyframe id, at most one per keyframe (the lowest slot). starts: (n + 1,). Returns the number.
    """
    n = 0
    for i in range(landmarks.shape[0]):
        starts[i] = n
        s = first[landmarks[i]]
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
    starts[landmarks.shape[0]] = n
    return n


@njit
def share_keyframe(a, b, first, next_, row, usable):  # type: ignore[no-untyped-def]
    """True if a keyframe observes both landmarks a and b, so that they cannot be the same."""
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
def rows_near(rows, T_w_k, position, reach, near):  # type: ignore[no-untyped-def]
    """Write those of rows (n,) whose T_w_k (m,4,4) lies within a cube of `reach` around (3,) to `near`, in order.

    Returns their number.
    """
    n = 0
    for i in range(rows.shape[0]):
        r = rows[i]
        if (
            abs(T_w_k[r, 0, 3] - position[0]) <= reach
            and abs(T_w_k[r, 1, 3] - position[1]) <= reach
            and abs(T_w_k[r, 2, 3] - position[2]) <= reach
        ):
            near[n] = r
            n += 1
    return n


@njit
def strong_pairs(  # type: ignore[no-untyped-def]
    rows, start, count, usable, root, is_live, first, next_, row, number, least, shared, touched, seen, a, b
):
    """Pairs of keyframes that share at least `least` landmarks: numbers of the older one to `a`, of the newer to `b`.

    rows: (n,) of the keyframes. start, count: slots of each row's keypoints. is_live: (slots,) of landmarks that are
    not culled. number: (m,) of each row in `rows`, -1 outside. shared: (m,) zeros in and out. touched: (m,) room. seen:
    (slots,) -1 in. Returns how many pairs there are; those for which `a` has no room are not written.
    """
    pairs = 0
    for i in range(rows.shape[0]):
        met = 0
        for k in range(start[rows[i]], start[rows[i]] + count[rows[i]]):
            if usable[k] == 0 or root[k] < 0 or is_live[root[k]] == 0 or seen[root[k]] == i:
                continue
            seen[root[k]] = i
            s = first[root[k]]
            while s >= 0:
                r = row[s]
                if usable[s] != 0 and number[r] >= 0 and number[r] < i:
                    if shared[r] == 0:
                        touched[met] = r
                        met += 1
                    shared[r] += np.int32(1)
                s = next_[s]
        for t in range(met):
            r = touched[t]
            if shared[r] >= least:
                if pairs < a.shape[0]:
                    a[pairs], b[pairs] = number[r], i
                pairs += 1
            shared[r] = 0
    return pairs


@njit
def covisibility(landmarks, first, next_, row, usable, shared):  # type: ignore[no-untyped-def]
    """Add the number of landmarks (n,) that keyframe row k observes to shared[k] (keyframes,)."""
    for i in range(landmarks.shape[0]):
        s = first[landmarks[i]]
        while s >= 0:
            if usable[s] != 0:
                shared[row[s]] += np.int32(1)
            s = next_[s]


@njit
def positions(landmarks, inv, row, uv, offset, scale, camera, pose, out):  # type: ignore[no-untyped-def]
    """Write the positions (n,3) in w of landmarks (n,) of inverse depths inv (n,) > 0 in their keyframes to out.

    row, uv, offset: of all keypoints. scale, camera (5,), pose (4,4): of all keyframes.
    """
    for i in range(landmarks.shape[0]):
        s = landmarks[i]
        k = row[s]
        z = scale[k] / inv[i]
        fx = camera[k, 0] if camera[k, 0] > 0.0 else 1.0
        fy = camera[k, 1] if camera[k, 1] > 0.0 else 1.0
        x = (np.float64(uv[s, 0]) + np.float64(offset[s, 0]) - camera[k, 2]) / fx * z
        y = (np.float64(uv[s, 1]) + np.float64(offset[s, 1]) - camera[k, 3]) / fy * z
        for j in range(3):
            out[i, j] = pose[k, j, 0] * x + pose[k, j, 1] * y + pose[k, j, 2] * z + pose[k, j, 3]
