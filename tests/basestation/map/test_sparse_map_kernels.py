"""Lists of observations in flat arrays, against sets."""

import numpy as np

from kiteline_basestation.map import sparse_map_kernels as kernels
from kiteline_core.geometry import se3


def test_links_and_fusions_agree_with_plain_sets() -> None:
    rng = np.random.default_rng(4)
    n, rows = 60, 12
    root, first, next_ = np.full(n, -1, np.int32), np.full(n, -1, np.int32), np.full(n, -1, np.int32)
    row = rng.integers(0, rows, n).astype(np.int32)
    usable = (rng.random(n) < 0.8).astype(np.uint8)
    keyframe_id = rng.permutation(rows).astype(np.int64) + 100
    members: dict[int, set[int]] = {p: set() for p in range(n)}
    for _ in range(300):
        if rng.random() < 0.85:
            slots = rng.choice(n, 3, replace=False).astype(np.int32)
            points = rng.integers(-1, 10, 3).astype(np.int32)
            kernels.link(slots, points, root, first, next_)
            for s, p in zip(slots.tolist(), points.tolist(), strict=True):
                for some in members.values():
                    some.discard(s)
                if p >= 0:
                    members[p].add(s)
        else:
            a, b = rng.choice(10, 2, replace=False).tolist()
            if root[a] not in (-1, a):
                continue  # slot a hangs elsewhere as an observation: it is no root
            moved = np.empty(n, np.int32)
            count = kernels.fuse(a, b, root, first, next_, moved)
            assert set(moved[:count].tolist()) == members[a]
            members[b] |= members[a]
            members[a] = set()
            if a not in members[b]:
                root[a] = -1  # it was no observation of itself: undo the mark, which `link` would follow
        points = np.arange(10, dtype=np.int32)
        assert kernels.count(points, first, next_) == sum(len(members[p]) for p in range(10))
        starts, seen = np.empty(11, np.int32), np.empty(n, np.int32)
        kernels.gather(points, first, next_, row, usable, keyframe_id, starts, seen)
        shared = np.zeros(rows, np.int32)
        kernels.covisibility(points, first, next_, row, usable, shared)
        assert shared.tolist() == [
            sum(1 for p in range(10) for s in members[p] if usable[s] and row[s] == r) for r in range(rows)
        ]
        for p in range(10):
            lowest: dict[int, int] = {}
            for s in sorted(members[p]):
                if usable[s]:
                    lowest.setdefault(int(keyframe_id[row[s]]), s)
            assert seen[starts[p] : starts[p + 1]].tolist() == [lowest[k] for k in sorted(lowest)]
        a, b = rng.choice(10, 2, replace=False).tolist()
        both = {int(row[s]) for s in members[a] if usable[s]} & {int(row[s]) for s in members[b] if usable[s]}
        assert kernels.share_keyframe(a, b, first, next_, row, usable) == bool(both)


def test_positions_agree_with_matrices() -> None:
    rng = np.random.default_rng(7)
    keyframes, slots, n = 5, 200, 90
    pose = np.stack([se3.exp(rng.normal(size=6)) for _ in range(keyframes)])
    camera = rng.uniform(300, 500, (keyframes, 5))
    camera[2, :2] = 0.0  # its camera is not known yet: any finite position will do
    scale = rng.uniform(0.5, 2.0, keyframes)
    row = rng.integers(0, keyframes, slots).astype(np.int32)
    uv = rng.uniform(0, 600, (slots, 2)).astype(np.float32)
    offset = rng.normal(size=(slots, 2)).astype(np.float32)
    landmarks = rng.permutation(slots)[:n].astype(np.int32)
    inv = rng.uniform(0.05, 2.0, n)
    out = np.full((n, 3), np.nan)
    kernels.positions(landmarks, inv, row, uv, offset, scale, camera, pose, out)
    assert np.isfinite(out).all()
    for i, s in enumerate(landmarks.tolist()):
        k = row[s]
        if k == 2:
            continue
        K = np.array([[camera[k, 0], 0, camera[k, 2]], [0, camera[k, 1], camera[k, 3]], [0, 0, 1]])
        seen = np.append(uv[s].astype(float) + offset[s], 1.0)
        local = np.linalg.solve(K, seen) * scale[k] / inv[i]
        np.testing.assert_allclose(out[i], (pose[k] @ np.append(local, 1.0))[:3], rtol=1e-9, atol=1e-9)
