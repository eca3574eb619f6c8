"""The map in other tools' formats, as bytes: labelled PLY, TUM trajectories, g2o pose graphs.

map_ply(points, labels, observations) -> base/map.ply
tum(t_ns, T_w_b) -> base/agentN.tum
g2o(keyframes, T_w_k, edges) -> the keyframe graph
"""

import numpy as np

from kiteline_core.arrays import F64, I64, U8
from kiteline_core.geometry import se3
from kiteline_core.geometry.tum import line

LABEL_COLOURS: U8 = np.array([[150, 150, 150], [88, 160, 96], [214, 96, 60]], np.uint8)  # unlabelled, ground, obstacle

# One vertex, packed: 18 bytes.
_VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3), ("label", "u1"), ("observations", "<u2")])


def map_ply(points: F64, labels: U8, observations: I64, *, metric: bool = True) -> bytes:
    """Map points as a binary PLY. points: (n,3) in w, m or, if not metric, in the map's own unit.

    labels: (n,) 0 unlabelled, 1 ground, 2 obstacle. observations: (n,) how many keyframes see each point. Raises
    ValueError when the lengths differ.
    """
    n = len(points)
    if len(labels) != n or len(observations) != n:
        raise ValueError(f"{n} points, {len(labels)} labels, {len(observations)} observation counts: want one a point")
    vertex = np.zeros(n, _VERTEX)
    vertex["xyz"] = points
    vertex["rgb"] = LABEL_COLOURS[np.minimum(labels, 2)]
    vertex["label"] = labels
    vertex["observations"] = np.minimum(observations, 65535)
    unit = "metres" if metric else "own unit of length"
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"comment map points in w, {unit}, z up; label 0 unlabelled, 1 ground, 2 obstacle\n"
        f"element vertex {n}\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        "property uchar label\nproperty ushort observations\nend_header\n"
    )
    return header.encode() + vertex.tobytes()


def tum(t_ns: I64, poses: F64) -> bytes:
    """A trajectory in TUM format. t_ns: (n,) int64. poses: (n,4,4), such as T_w_b. One line a pose."""
    return "".join(line(int(t), pose) for t, pose in zip(t_ns, poses, strict=True)).encode()


def g2o(keyframes: I64, poses: F64, edges: I64, scale: F64 | None = None) -> bytes:
    """A pose graph for g2o and its readers. keyframes: (n,) ids. poses: (n,4,4) T_w_k. edges: (e,2) rows of poses.

    Vertices are numbered by row, for many readers hold 32 bits only; a comment names each keyframe. An edge
    measures the relative pose as it stands, with the information 1. The first vertex is fixed.
    scale: (n,) units of w in one of those in which a keyframe's agent measures; the comment tells it where it is not 1.
    """
    scale = np.ones(len(keyframes)) if scale is None else scale
    lines = [
        f"# vertex {i} is keyframe {k}{'' if s == 1.0 else f', scale {s:.9g}'}\n"
        for i, (k, s) in enumerate(zip(keyframes, scale, strict=True))
    ]
    lines += [f"VERTEX_SE3:QUAT {i} {_pose_text(pose)}\n" for i, pose in enumerate(poses)]
    if len(poses):
        lines.append("FIX 0\n")
    information = " ".join(str(int(i == j)) for i in range(6) for j in range(i, 6))
    for a, b in edges:
        lines.append(f"EDGE_SE3:QUAT {a} {b} {_pose_text(se3.inverse(poses[a]) @ poses[b])} {information}\n")
    return "".join(lines).encode()


def _pose_text(pose: F64) -> str:
    """x y z qx qy qz qw of a pose (4,4)."""
    return line(0, pose).split(" ", 1)[1].rstrip()
