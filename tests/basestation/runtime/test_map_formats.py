"""PLY, TUM and g2o, read back by other means."""

from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from kiteline_basestation.runtime import map_formats
from kiteline_core.geometry import se3


def poses(n: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.stack([se3.exp(rng.normal(0, 1.0, 6)) for _ in range(n)])


def test_ply_header_describes_its_bytes() -> None:
    points = np.array([[1.0, -2.0, 0.5], [100.25, 3.0, -4.0], [0.0, 0.0, 0.0]])
    data = map_formats.map_ply(points, np.array([0, 1, 2], np.uint8), np.array([2, 70000, 3]))
    header, body = data.split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 3" in lines
    kinds = {"float": "<f4", "uchar": "u1", "ushort": "<u2"}
    names = [line.split()[1:] for line in lines if line.startswith("property")]
    vertex = np.frombuffer(body, np.dtype([(name, kinds[kind]) for kind, name in names]))
    assert vertex["x"].tolist() == [1.0, 100.25, 0.0] and vertex["z"].tolist() == [0.5, -4.0, 0.0]
    assert vertex["label"].tolist() == [0, 1, 2]
    assert vertex["observations"].tolist() == [2, 65535, 3]
    assert len({(v["red"], v["green"], v["blue"]) for v in vertex}) == 3


def test_ply_wants_one_label_a_point() -> None:
    with pytest.raises(ValueError, match="2 points, 1 labels"):
        map_formats.map_ply(np.zeros((2, 3)), np.zeros(1, np.uint8), np.zeros(2, np.int64))


def test_ply_of_nothing_is_a_ply() -> None:
    data = map_formats.map_ply(np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(0, np.int64))
    assert data.startswith(b"ply\n") and data.endswith(b"end_header\n") and b" metres," in data
    own = map_formats.map_ply(np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(0, np.int64), metric=False)
    assert b"metres" not in own and b"own unit of length" in own


@given(st.lists(st.integers(0, 2**62), min_size=1, max_size=4, unique=True))
def test_tum_keeps_every_nanosecond(stamps: list[int]) -> None:
    t_ns = np.array(sorted(stamps), np.int64)
    truth = poses(len(t_ns))
    rows = [line.split() for line in map_formats.tum(t_ns, truth).decode().splitlines()]
    assert [int(row[0].replace(".", "")) for row in rows] == t_ns.tolist()
    for row, pose in zip(rows, truth, strict=True):
        x, y, z, qx, qy, qz, qw = map(float, row[1:])
        back = se3.from_quaternion(np.array([qw, qx, qy, qz]), np.array([x, y, z]))
        np.testing.assert_allclose(back, pose, atol=1e-8)


def test_g2o_is_read_by_gtsam_and_has_no_error(tmp_path: Path) -> None:
    truth = poses(4)
    edges = np.array([[0, 1], [1, 2], [2, 3], [0, 3]])
    data = map_formats.g2o(np.array([2**50, 2**50 + 1, 5, 6]), truth, edges)
    (tmp_path / "graph.g2o").write_bytes(data)
    graph, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    assert graph.size() == 4 and values.size() == 4
    assert graph.error(values) < 1e-12
    np.testing.assert_allclose(values.atPose3(2).matrix(), truth[2], atol=1e-8)
    assert f"# vertex 0 is keyframe {2**50}\n" in data.decode()
    noted = map_formats.g2o(np.array([5, 6, 7, 8]), truth, edges, scale=np.array([1.0, 1.0, 2.5, 2.5])).decode()
    assert "# vertex 1 is keyframe 6\n" in noted and "# vertex 2 is keyframe 7, scale 2.5\n" in noted
