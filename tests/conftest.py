"""What all tests share: one thread, a reproducible hypothesis in CI, and where the recordings lie."""

import gc
import os
import sys
from pathlib import Path

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")  # before numpy is loaded: results and timings do not depend on the machine

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, settings

ROOT = Path(__file__).resolve().parent.parent
EMPTY = np.zeros((1, 1), np.uint8)
IN_CI = os.environ.get("CI", "").lower() in ("1", "true")

gc.disable()  # until all tests are collected: nearly all that is made till then stays
cv2.setNumThreads(1)
settings.register_profile(
    "default", deadline=None, suppress_health_check=[HealthCheck.too_slow], max_examples=40
)  # `kiteline bench fuzz` makes the long runs
settings.register_profile("ci", parent=settings.get_profile("default"), derandomize=True, database=None)
settings.load_profile("ci" if IN_CI else "default")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With `-m alone` only files that name the mark are imported: all of them take as long as some of those tests."""
    if config.option.markexpr == "alone" and collection_path.match("test_*.py"):
        return b"mark.alone" not in collection_path.read_bytes() or None
    return None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of whole programs come first: they wait most, and their files take long, which is no way to end a run."""
    items.sort(key=lambda item: item.path.parent != ROOT / "tests" / "system")


def pytest_collection_finish() -> None:
    """From here on, the collector leaves out what stays: modules and tests, a million objects."""
    gc.freeze()
    gc.enable()


@pytest.fixture
def drawn() -> None:
    """For tests that look at the picture of a flight: others get an empty one, as drawing takes half of their time."""


@pytest.fixture(autouse=True)
def _no_pictures(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    results = sys.modules.get("kiteline_lab.flights.results")
    if results is not None and "drawn" not in request.fixturenames:
        monkeypatch.setattr(results, "plot_trajectories", lambda path, *_, **__: cv2.imwrite(str(path), EMPTY))


@pytest.fixture(scope="session", autouse=True)
def _state_of_tests(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Numbers of starts of the tests are their own."""
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of recordings: KITELINE_DATA, else ../shared/data beside the repository.

    Skips where there is none, but fails in CI: a check that silently runs nothing proves nothing.
    """
    named = os.environ.get("KITELINE_DATA")
    folder = Path(named) if named else ROOT.parent / "shared" / "data"
    if folder.is_dir():
        return folder
    text = f"no recordings at {folder}: set KITELINE_DATA to the folder that holds them"
    if IN_CI:
        pytest.fail(text)
    pytest.skip(text)


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of 1.5 s that agents track in milliseconds: a rectified 320x240 stereo pair at 20 Hz slides past a textured
    wall 2 m away, with its ground truth. No data needed.
    """
    from kiteline_core.frame import Frame, Trajectory
    from kiteline_core.geometry.cameras import CameraModel, CameraRig
    from kiteline_hw.logs.mcap_log import LogWriter
    from tests.wall import STEP_M

    frames, depth_m, baseline_m, focal = 30, 2.0, 0.1, 200.0
    random = np.random.default_rng(1)
    wall = cv2.GaussianBlur(random.integers(0, 256, (260, 480), np.uint8), (0, 0), 1.2)
    wall = cv2.normalize(wall, None, 20, 235, cv2.NORM_MINMAX).astype(np.uint8)
    camera = CameraModel(320, 240, focal, focal, 159.5, 119.5)
    T_c_r = np.eye(4)
    T_c_r[0, 3] = baseline_m
    stamps = 1_000_000_000 + 50_000_000 * np.arange(frames, dtype=np.int64)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = STEP_M * np.arange(frames)

    def seen_from(x_m: float) -> np.ndarray:
        shift = np.array([[1.0, 0.0, -focal * x_m / depth_m], [0.0, 1.0, -5.0]])
        return cv2.warpAffine(wall, shift, (320, 240), flags=cv2.INTER_LINEAR)

    path = tmp_path_factory.mktemp("recording") / "wall.mcap"
    with LogWriter(path, {"made": "for tests"}) as log:
        log.rig(int(stamps[0]), CameraRig(camera, camera, np.eye(4), T_c_r, has_body=False), None)
        for t_ns, pose in zip(stamps, poses):
            log.frame(Frame(int(t_ns), seen_from(pose[0, 3]), seen_from(pose[0, 3] + baseline_m)))
        log.ground_truth(Trajectory(stamps, poses))
    return path
