import errno
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from kiteline_core.arrays import F64
from kiteline_core.frame import Trajectory
from kiteline_core.geometry import se3
from kiteline_lab.evaluation.trajectories import TrajectoryError, read
from kiteline_lab.plots import plot
from kiteline_lab.tools import evaluate

TUM = "1403715273.262142976 0.1 0.2 0.3 0 0 0 1\n1403715273.312143104 0.2 0.2 0.3 0 0 0.6 0.8\n"


def arc(n: int) -> list[np.ndarray]:
    poses = [se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.02 * i, 0.0])) for i in range(n)]
    for i, pose in enumerate(poses):
        pose[:3, 3] = [np.sin(0.1 * i), 0.0, 0.3 * i]
    return poses


def tum_text(poses: list[np.ndarray], period_s: float = 0.1, start_s: float = 100.0) -> str:
    rows = []
    for i, pose in enumerate(poses):
        w, x, y, z = se3.quaternion_from_rotation(pose[:3, :3])
        p = " ".join(f"{v:.9f}" for v in pose[:3, 3])
        rows.append(f"{start_s + i * period_s:.9f} {p} {x:.9f} {y:.9f} {z:.9f} {w:.9f}\n")
    return "# t x y z qx qy qz qw\n" + "".join(rows)


def kitti_text(poses: list[np.ndarray]) -> str:
    return "".join(" ".join(f"{v:.9e}" for v in pose[:3].ravel()) + "\n" for pose in poses)


def test_tum_times_are_exact_and_quaternions_end_with_w(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_text("# comment\n\n" + TUM)
    file = read(str(tmp_path / "a.tum"))
    assert file.trajectory.t_ns.tolist() == [1403715273262142976, 1403715273312143104]
    np.testing.assert_allclose(file.trajectory.T_w_b[1, :3, 3], [0.2, 0.2, 0.3])
    np.testing.assert_allclose(file.trajectory.T_w_b[1, :3, 0], [0.28, 0.96, 0.0], atol=1e-12)


def test_euroc_table(tmp_path: Path) -> None:
    (tmp_path / "data.csv").write_text(
        "#timestamp, p_RS_R_x [m], ...\n1403636580838555648,4.6,-1.7,0.7,0.8,0.0,0.0,0.6,0.1,0.2\n"
    )
    t = read(str(tmp_path / "data.csv")).trajectory
    assert t.t_ns.tolist() == [1403636580838555648]
    np.testing.assert_allclose(t.T_w_b[0, :3, 0], [0.28, 0.96, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    "line",
    [
        "1403715273262142976.0000000000,0.1,0.2,0.3,0.8,0,0,0.6\n",  # ORB-SLAM3's truth of EuRoC's flights
        "1403715273262142976.000000 0.1 0.2 0.3 0 0 0.6 0.8\n",  # its trajectories of these
        "1403715273262142.976 0.1 0.2 0.3 0 0 0.6 0.8\n",  # us, as cameras' own software writes
    ],
)
def test_times_of_other_programs_are_read(line: str, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text(line)
    t = read(str(tmp_path / "a.txt")).trajectory
    assert t.t_ns.tolist() == [1403715273262142976]
    np.testing.assert_allclose(t.T_w_b[0, :3, 0], [0.28, 0.96, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no pose"),
        ("1403715273262142976.5,0,0,0,1,0,0,0\n", "no time in nanoseconds"),
        ("a b c\n", "line 1 has 3 columns"),
        (TUM + "1403715273.4 0.1 0.2\n", "line 3 has 3 columns"),
        (TUM + "1403715273.3 0 0 0 0 0 0 1\n", "line 3: its time is not after"),
        (TUM + "1403715274.3 0 0 nan 0 0 0 1\n", "line 3: a value is not finite"),
        (TUM + "1403715274.3 0 0 x 0 0 0 1\n", "line 3: expected numbers"),
        ("1.0 0 0 0 1 1 0 1\n", "quaternion has length 1.732"),
        ("1 2 3 4 5 6 7 8 9 10 11 12\n", "no rotation matrix"),
        ("t,x,y\n1,2,3\n", "expected EuRoC's"),
        ("9" * 5000 + " 0 0 0 0 0 0 1\n", "line 1: '999"),
        ("9" * 19 + " 0 0 0 0 0 0 1\n", "no time in seconds"),
        ("\N{SUPERSCRIPT TWO} 0 0 0 0 0 0 1\n", "no time in seconds"),
        ("9" * 5000 + ",0,0,0,1,0,0,0\n", "no time in nanoseconds"),
    ],
)
def test_what_is_no_trajectory_is_named_by_line(text: str, words: str, tmp_path: Path) -> None:
    file = tmp_path / "bad.txt"
    file.write_text(text)
    with pytest.raises(TrajectoryError) as caught:
        read(str(file))
    assert words in str(caught.value)
    assert str(file) in str(caught.value)


def test_a_picture_and_a_missing_file_are_errors_too(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(TrajectoryError, match="not a text file"):
        read(str(tmp_path / "a.txt"))
    with pytest.raises(TrajectoryError, match="no such file"):
        read(str(tmp_path / "b.txt"))


def test_kitti_poses_take_the_other_one_s_times_in_order(tmp_path: Path) -> None:
    poses = arc(20)
    (tmp_path / "poses.txt").write_text(kitti_text(poses))
    (tmp_path / "est.tum").write_text(tum_text(poses))
    e = evaluate.evaluate_files(str(tmp_path / "est.tum"), str(tmp_path / "poses.txt"))
    assert e.matched == 20
    assert e.ate_m.max < 1e-7


def test_a_shorter_estimate_meets_kitti_poses_at_10_hz_or_at_times_txt(tmp_path: Path) -> None:
    poses = arc(20)
    (tmp_path / "poses.txt").write_text(kitti_text(poses))
    (tmp_path / "est.tum").write_text(tum_text(poses[5:], 0.1, 0.5))
    e = evaluate.evaluate_files(str(tmp_path / "est.tum"), str(tmp_path / "poses.txt"))
    assert e.matched == 15
    assert e.ate_m.max < 1e-7
    (tmp_path / "times.txt").write_text("".join(f"{7.0 + 0.2 * i:e}\n" for i in range(20)))
    (tmp_path / "est.tum").write_text(tum_text(poses[5:], 0.2, 8.0))
    assert evaluate.evaluate_files(str(tmp_path / "est.tum"), str(tmp_path / "poses.txt")).ate_m.max < 1e-7


def test_times_txt_of_another_length_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text(kitti_text(arc(5)))
    (tmp_path / "times.txt").write_text("0 0.1 0.2\n")
    with pytest.raises(TrajectoryError, match=r"3 times, but .* has 5 poses"):
        read(str(tmp_path / "poses.txt"))


def test_command_prints_a_table_or_json_and_draws(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "gt.tum").write_text(tum_text(arc(30)))
    (tmp_path / "est.tum").write_text(tum_text([p + 0.0 for p in arc(25)]))
    files = [str(tmp_path / "est.tum"), str(tmp_path / "gt.tum")]
    assert evaluate.main([*files, "--plot", str(tmp_path / "p" / "plot.png")]) == 0
    text = capsys.readouterr().out
    assert "25 of 25 matched" in text
    assert "82.8% of the time" in text
    assert (tmp_path / "p" / "plot.png").read_bytes().startswith(b"\x89PNG")
    assert evaluate.main([*files, "--json", "--scale"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["alignment"] == "sim3"
    assert result["ate_m"]["rmse"] < 1e-7
    assert result["rpe_frame"]["translation_m"]["n"] == 24


def test_plot_without_truth_and_of_an_empty_line(tmp_path: Path) -> None:
    from kiteline_lab.plots.plot import Line, plot_trajectories

    poses = np.stack(arc(30))
    whole = Trajectory(np.arange(30, dtype=np.int64) * 10**8, poses)
    nothing = Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    plot_trajectories(tmp_path / "a.png", [Line("live", whole), Line("lost", nothing)])
    plot_trajectories(tmp_path / "b.png", [Line("live", whole), Line("lost", nothing)])
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    plot_trajectories(tmp_path / "c.png", [Line("live", whole), Line("lost", nothing)], whole, "both", align=True)
    assert (tmp_path / "c.png").stat().st_size > 10_000


@pytest.mark.parametrize("name", ["a$b_{$.mcap", "$", "\udcff\n.mcap", "\\frac"])
def test_a_plot_of_a_file_of_any_name(name: str, tmp_path: Path) -> None:
    line = Trajectory(np.arange(3), np.tile(np.eye(4), (3, 1, 1)))
    plot.plot_trajectories(tmp_path / "a.png", [plot.Line(name, line)], line, name)
    assert (tmp_path / "a.png").stat().st_size > 0


def test_errors_at_the_ends_of_a_line_are_against_the_truth_beyond_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[F64] = []
    monkeypatch.setattr(plot, "_draw_errors", lambda axes, errors: drawn.extend(off for _, off, _ in errors))
    t_ns = np.arange(11, dtype=np.int64) * 20_000_000
    poses = np.tile(np.eye(4), (11, 1, 1))
    poses[:, 0, 3] = 0.1 * np.arange(11)
    between = Trajectory(t_ns[:-1] + 10_000_000, poses[:-1].copy())
    between.T_w_b[:, 0, 3] += 0.05
    plot.plot_trajectories(tmp_path / "a.png", [plot.Line("live", between)], Trajectory(t_ns, poses))
    assert len(drawn[0]) == 10
    assert drawn[0].max() < 1e-9


@pytest.mark.parametrize("seconds", ["-1", "nan", "inf", "1e9"])
def test_a_difference_in_time_that_is_none(seconds: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        evaluate.main(["a.tum", "b.tum", "--max-difference", seconds])
    assert "--max-difference" in capsys.readouterr().err


def test_a_plot_is_a_png_whatever_its_name_and_the_old_one_stays_on_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = [plot.Line("live", Trajectory(np.arange(3), np.tile(np.eye(4), (3, 1, 1))))]
    plot.plot_trajectories(tmp_path / "a.plot", line)
    content = (tmp_path / "a.plot").read_bytes()
    assert content.startswith(b"\x89PNG")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space"):
        plot.plot_trajectories(tmp_path / "a.plot", line, title="new")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [content]


def test_lines_in_a_unit_of_their_own_are_drawn_by_scale_and_say_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A flight of one camera without a scale was drawn beside the truth, with another error than in the report."""
    drawn: dict[str, list[str]] = {"titles": [], "names": []}
    monkeypatch.setattr(plot, "_style", lambda axes, title, x: drawn["titles"].append(title))
    monkeypatch.setattr(plot, "_as_text", lambda name: (drawn["names"].append(name), name)[1])
    poses = np.stack(arc(30))
    truth = Trajectory(np.arange(30, dtype=np.int64) * 10**8, poses)
    half = Trajectory(truth.t_ns, poses.copy())
    half.T_w_b[:, :3, 3] *= 0.5
    plot.plot_trajectories(tmp_path / "a.png", [plot.Line("live", half, own_unit=True)], truth, align=True)
    assert drawn["names"] == ["live  (ATE 0.0 mm, scale fitted)"]
    assert drawn["titles"][0] == "from above, m; dot: start"
    plot.plot_trajectories(tmp_path / "a.png", [plot.Line("live", half, own_unit=True)])
    assert drawn["titles"][3:] == ["from above, own unit of length; dot: start", "height, own unit of length"]


def test_colours_of_lines_differ_for_colour_blind_readers() -> None:
    """Red and green were one colour to one man in twelve."""
    # Machado, Oliveira and Fernandes, 2009: red-, green- and blue-blind, on linear RGB.
    blind = np.array(
        [
            [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
            [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
            [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
        ]
    )
    rgb = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in plot.COLOURS]) / 255.0
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    for seen in np.clip(np.einsum("bij,nj->bni", blind, linear), 0.0, 1.0):
        coded = np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)
        lab = cv2.cvtColor(np.asarray(coded[None], np.float32), cv2.COLOR_RGB2Lab)[0]
        apart = np.linalg.norm(lab[:, None] - lab[None], axis=2)[np.triu_indices(len(lab), 1)]
        assert apart.min() > 12.0


def test_long_titles_are_not_cut_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(plot, "_as_text", lambda name: (told.append(name), name)[1])
    line = [plot.Line("live", Trajectory(np.arange(3), np.tile(np.eye(4), (3, 1, 1))))]
    plot.plot_trajectories(tmp_path / "a.png", line, title="mcap:" + 40 * "folder/" + "flight.mcap")
    assert told[-1].startswith("…") and told[-1].endswith("/flight.mcap") and len(told[-1]) <= 101
