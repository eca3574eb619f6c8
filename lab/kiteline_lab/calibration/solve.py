"""Calibrates one camera or a pair by views of a board: intrinsics, poses of the board, extrinsics, all at once.

Levenberg-Marquardt with Huber weights. The poses are eliminated (Schur complement); what is left are the intrinsics of
each camera and the place of the right one. One solver for both lenses, and for points beyond 90°.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from kiteline_core.arrays import F64, I64, Bool
from kiteline_core.errors import KitelineError
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import CameraModel, Lens
from kiteline_core.wording import counted
from kiteline_lab.calibration.lenses import derivatives, project, rays
from kiteline_lab.calibration.views import View

FEWEST_VIEWS = 4
_FOCALS = (0.25, 0.33, 0.42, 0.55, 0.7, 0.9, 1.2, 1.6, 2.2)  # of the image's width, tried as a start
_START_VIEWS = 12
_FRONT = 0.2  # cosine to the middle ray of corners that fix a pose
_NO_POSE_PX = 1e3
_HUBER_PX = 1.0
_MOST_STEPS = 60
_SMALL_GAIN = 1e-7  # of the cost, below which steps end
_EXACT_PX = 1e-6  # rms that needs no better one
_LOOSE = 1.0  # sigma of a coefficient before anything is seen: only what the views do not tell is held by it
_BAD_VIEW = 4.0  # times the median rms, and
_BAD_VIEW_PX = 1.0  # px that a view's rms must exceed to be left out


class CalibrationFailed(KitelineError):
    """Views that do not calibrate a camera; the text says what to show it."""


@dataclass(frozen=True, slots=True)
class Residuals:
    """Of one camera. px: (n, 2) of the corners seen, error_px: (n, 2) projected minus seen, view: (n,) which view."""

    px: F64
    error_px: F64
    view: I64

    @property
    def rms_px(self) -> float:
        """Root mean square of the distance of corners from where they should be."""
        return float(np.sqrt((self.error_px**2).sum(1).mean())) if len(self.px) else 0.0


@dataclass(frozen=True, slots=True)
class Calibrated:
    """Cameras as calibrated.

    T_c_r: (4,4) right camera in the left one. sigma: (m,) of the estimates: intrinsics of each camera, then translation
    (m) and turn (rad) of the right one. poses: (k,4,4) board in the left camera. left_out: views that did not fit.
    """

    cameras: tuple[CameraModel, ...]
    T_c_r: F64 | None
    residuals: tuple[Residuals, ...]
    sigma: F64
    poses: F64
    left_out: int

    def focal_sigma(self, camera: int) -> float:
        """Relative uncertainty of a camera's focal length."""
        k = 4 + len(self.cameras[camera].distortion)
        start = sum(4 + len(c.distortion) for c in self.cameras[:camera])
        assert start + k <= len(self.sigma)
        return float(self.sigma[start] / self.cameras[camera].fx)

    def baseline_sigma(self) -> float:
        """Relative uncertainty of the baseline; 0 for one camera."""
        if self.T_c_r is None:
            return 0.0
        return float(np.linalg.norm(self.sigma[-6:-3]) / np.linalg.norm(self.T_c_r[:3, 3]))


@dataclass(slots=True)
class _State:
    v: list[F64]  # intrinsics by camera
    T_r_c: F64
    poses: F64


def calibrate(
    points_m: F64, views: Sequence[View], sizes: Sequence[tuple[int, int]], lens: Lens, coefficients: int
) -> Calibrated:
    """Calibrate by views of a board with corners `points_m`. sizes: width and height by camera.

    coefficients: of a radial-tangential lens, 4, 5 or 8. Raises CalibrationFailed.
    """
    n = len(sizes)
    for k in range(n):
        seen = sum(view.eyes[k] is not None for view in views)
        if seen < FEWEST_VIEWS:
            who = f"the {('left', 'right')[k]} camera" if n == 2 else "the camera"
            raise CalibrationFailed(
                f"{counted(seen, 'view')} of the board by {who}: expected {FEWEST_VIEWS} at least, better 15 to 40; "
                "check the board's squares, kind and dictionary against --board, the light and the focus"
            )
    d = 4 if lens is Lens.EQUIDISTANT else coefficients
    state, used = _start(points_m, views, sizes, lens, d)
    _refine(points_m, used, state, lens, fixed=True)
    _refine(points_m, used, state, lens, fixed=False)
    rms = _view_rms(points_m, used, state, lens)
    if (rms > _BAD_VIEW_PX).any():
        _find_again(points_m, used, state, lens, rms, max(_BAD_VIEW_PX, float(np.median(rms))))
        _refine(points_m, used, state, lens, fixed=False)
        rms = _view_rms(points_m, used, state, lens)
    good = rms <= max(_BAD_VIEW * float(np.median(rms)), _BAD_VIEW_PX)
    left_out = len(views) - int(good.sum())
    if not good.all() and good.sum() >= FEWEST_VIEWS:
        used = [view for view, ok in zip(used, good) if ok]
        state.poses = state.poses[good]
        _refine(points_m, used, state, lens, fixed=False)
    sigma = _refine(points_m, used, state, lens, fixed=False)
    models = tuple(_model(v, size, lens) for v, size in zip(state.v, sizes))
    for model in models:
        if not (np.isfinite(sigma).all() and 0.05 < model.fx / model.width < 20.0 and model.fy > 0):
            raise CalibrationFailed(
                "no focal length fits these views: show the board tilted by 20 to 45°, at several distances"
            )
    residuals = tuple(_residuals(points_m, used, state, lens, k) for k in range(n))
    return Calibrated(models, se3.inverse(state.T_r_c) if n == 2 else None, residuals, sigma, state.poses, left_out)


def _model(v: F64, size: tuple[int, int], lens: Lens) -> CameraModel:
    fx, fy, cx, cy, *d = (float(x) for x in v)
    return CameraModel(*size, fx, fy, cx, cy, lens, tuple(d))


def _start(
    points_m: F64, views: Sequence[View], sizes: Sequence[tuple[int, int]], lens: Lens, d: int
) -> tuple[_State, list[View]]:
    """Focal lengths by trial, poses of the board by its plane, the right camera by the views of both."""
    vs: list[F64] = []
    poses: list[list[F64 | None]] = []
    for k, size in enumerate(sizes):
        most = sorted((v for v in views if v.eyes[k] is not None), key=lambda v: -len(v.eyes[k].ids))  # type: ignore[union-attr]
        trials = []
        for share in _FOCALS:
            v = np.array([share * size[0], share * size[0], 0.5 * (size[0] - 1), 0.5 * (size[1] - 1), *[0.0] * d])
            errors = [_pose(points_m, view, k, v, lens)[1] for view in most[:_START_VIEWS]]
            trials.append((float(np.median(errors)), share, v))
        vs.append(min(trials)[2])
        poses.append([None if view.eyes[k] is None else _pose(points_m, view, k, vs[-1], lens)[0] for view in views])
    T_r_c = np.eye(4)
    if len(sizes) == 2:
        both = [right @ se3.inverse(left) for left, right in zip(*poses) if left is not None and right is not None]
        if len(both) < FEWEST_VIEWS:
            raise CalibrationFailed(
                f"{counted(len(both), 'view')} of the board by both cameras: expected {FEWEST_VIEWS} at least, better "
                "15: hold it where both see it; images of a pair must be of the same instant"
            )
        shifts = np.array([T[:3, 3] for T in both])
        apart = np.linalg.norm(shifts[:, None] - shifts[None], axis=2).sum(1)
        T_r_c = both[int(apart.argmin())]
    chosen, used = [], []
    for i, view in enumerate(views):
        T = poses[0][i]
        of_right = poses[1][i] if len(sizes) == 2 else None
        if T is None and of_right is not None:
            T = se3.inverse(T_r_c) @ of_right
        if T is not None:
            chosen.append(T)
            used.append(view)
    if len(used) < FEWEST_VIEWS:
        raise CalibrationFailed("too few views with a pose of the board: check --board against the printed one")
    return _State(vs, T_r_c, np.array(chosen)), used


def _pose(points_m: F64, view: View, camera: int, v: F64, lens: Lens) -> tuple[F64 | None, float]:
    """Board in the camera (4,4) by an ideal lens, and its median error in px."""
    corners = view.eyes[camera]
    assert corners is not None
    points, seen = points_m[corners.ids], rays(lens, v, corners.px)
    # seen along the middle ray, so that a board beside the camera can be found too
    R_m_c = _turn_to_axis(seen.mean(0))
    seen = seen @ R_m_c.T
    front = seen[:, 2] > _FRONT
    if front.sum() < 4:
        return None, _NO_POSE_PX
    xy = seen[front, :2] / seen[front, 2:]
    best: tuple[F64 | None, float] = (None, _NO_POSE_PX)
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            np.ascontiguousarray(points[front]), xy[:, None], np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:
        return best
    for turn, shift in zip(turns, shifts):
        rotation, t = np.asarray(turn, np.float64).ravel(), np.asarray(shift, np.float64).ravel()
        if not (np.isfinite(rotation).all() and np.isfinite(t).all()):
            continue
        T_m_board = se3.from_rt(se3.so3_exp(rotation), t)
        if se3.transform(T_m_board, points[front])[:, 2].min() <= 0:
            continue  # seen corners lie ahead; the board's origin need not
        T = se3.from_rt(R_m_c.T, np.zeros(3)) @ T_m_board
        error = float(np.median(np.linalg.norm(project(lens, v, se3.transform(T, points)) - corners.px, axis=1)))
        if error < best[1]:
            best = T, error
    return best


def _turn_to_axis(direction: F64) -> F64:
    """Rotation (3,3) that turns a direction to the optical axis."""
    z = direction / np.linalg.norm(direction)
    axis = np.cross(z, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    return np.eye(3) if sine < 1e-9 else se3.so3_exp(axis / sine * float(np.arctan2(sine, z[2])))


def _find_again(points_m: F64, views: Sequence[View], state: _State, lens: Lens, rms: F64, least_px: float) -> None:
    """New poses for views that do not fit, by the lens as it is known now; a flat board has two that look alike."""
    for i, view in enumerate(views):
        if rms[i] <= least_px:
            continue
        for k, T_c_r in enumerate((np.eye(4), se3.inverse(state.T_r_c))):
            if k < len(view.eyes) and view.eyes[k] is not None:
                T, error = _pose(points_m, view, k, state.v[k], lens)
                if T is not None and error < rms[i]:
                    state.poses[i] = T_c_r @ T
                break


@dataclass(frozen=True, slots=True)
class _Seen:
    """All corners of one camera. view: (n,) of which view, in ascending order."""

    view: I64
    points: F64
    px: F64


def _seen(points_m: F64, views: Sequence[View], cameras: int) -> list[_Seen]:
    out = []
    for k in range(cameras):
        eyes = [(i, eye) for i, view in enumerate(views) if (eye := view.eyes[k]) is not None]
        which = np.concatenate([np.full(len(eye.ids), i, np.int64) for i, eye in eyes])
        ids = np.concatenate([eye.ids for _, eye in eyes])
        out.append(_Seen(which, points_m[ids], np.concatenate([eye.px for _, eye in eyes])))
    return out


def _in_eye(state: _State, camera: int, seen: _Seen) -> tuple[F64, F64]:
    """Corners in the left camera and in the camera."""
    T = state.poses[seen.view]
    left = np.einsum("nij,nj->ni", T[:, :3, :3], seen.points) + T[:, :3, 3]
    return left, left if camera == 0 else se3.transform(state.T_r_c, left)


def _turned(points: F64) -> F64:
    """Derivatives (n, 3, 6) of points by a small motion of them: translation, rotation."""
    out = np.zeros((len(points), 3, 6))
    out[:, 0, 0] = out[:, 1, 1] = out[:, 2, 2] = 1.0
    x, y, z = points.T
    out[:, 0, 4], out[:, 0, 5] = z, -y
    out[:, 1, 3], out[:, 1, 5] = -z, x
    out[:, 2, 3], out[:, 2, 4] = y, -x
    return out


def _cost(seen: Sequence[_Seen], state: _State, lens: Lens) -> float:
    total = sum(float((_LOOSE**-2 * v[4:] ** 2).sum()) for v in state.v)
    for k, of_camera in enumerate(seen):
        _, eye = _in_eye(state, k, of_camera)
        size = np.linalg.norm(project(lens, state.v[k], eye) - of_camera.px, axis=1)
        total += float(np.where(size < _HUBER_PX, size**2, 2.0 * _HUBER_PX * size - _HUBER_PX**2).sum())
    return total if np.isfinite(total) else np.inf


def _refine(points_m: F64, views: Sequence[View], state: _State, lens: Lens, *, fixed: bool) -> F64:
    """Minimise the residuals, in place; the sigmas of what all views share. fixed: centres and coefficients stay."""
    n = len(state.v)
    sizes = [len(v) for v in state.v]
    starts = np.cumsum([0, *sizes])
    width = int(starts[-1]) + (6 if n == 2 else 0)
    free = np.ones(width, np.bool_)
    if fixed:
        for start, size in zip(starts, sizes):
            free[start + 2 : start + size] = False
    seen = _seen(points_m, views, n)
    corners = sum(len(of_camera.px) for of_camera in seen)
    damping, cost = 1e-3, _cost(seen, state, lens)
    for _ in range(_MOST_STEPS):
        H, g, per_view = _normal(seen, state, lens, starts, width)
        while True:
            step, moves = _step(H, g, per_view, damping, free)
            trial = _State(
                [v + step[a : a + size] for v, a, size in zip(state.v, starts, sizes)],
                se3.exp(step[-6:]) @ state.T_r_c if n == 2 else state.T_r_c,
                np.array([se3.exp(m) @ T for m, T in zip(moves, state.poses)]),
            )
            new = _cost(seen, trial, lens)
            if new < cost or damping > 1e8:
                break
            damping *= 10.0
        if not new < cost:
            break
        gain, cost = cost - new, new
        state.v, state.T_r_c, state.poses = trial.v, trial.T_r_c, trial.poses
        damping = max(damping * 0.1, 1e-9)
        if gain < _SMALL_GAIN * cost or cost < _EXACT_PX**2 * corners:
            break
    H, g, per_view = _normal(seen, state, lens, starts, width)
    freedom = max(1, 2 * corners - width - 6 * len(views))
    S, _ = _reduced(H, g, per_view, 0.0)
    return np.sqrt(np.maximum(np.diag(np.linalg.pinv(S, hermitian=True)), 0.0) * cost / freedom)


_Block = tuple[F64, F64, F64]  # pose by pose (6,6), shared by pose (m,6), gradient (6,)


def _normal(seen: Sequence[_Seen], state: _State, lens: Lens, starts: I64, width: int) -> tuple[F64, F64, list[_Block]]:
    H, g = np.zeros((width, width)), np.zeros(width)
    count = len(state.poses)
    Hpp, Hap, gp = np.tile(1e-12 * np.eye(6), (count, 1, 1)), np.zeros((count, width, 6)), np.zeros((count, 6))
    for k, of_camera in enumerate(seen):
        v, start, end = state.v[k], int(starts[k]), int(starts[k + 1])
        d = np.arange(start + 4, end)
        H[d, d] += _LOOSE**-2
        g[d] -= _LOOSE**-2 * v[4:]
        left, eye = _in_eye(state, k, of_camera)
        error = project(lens, v, eye) - of_camera.px
        weight = np.sqrt(_HUBER_PX / np.maximum(np.linalg.norm(error, axis=1), _HUBER_PX))[:, None, None]
        by_v, by_x = derivatives(lens, v, eye)
        by_left = by_x if k == 0 else by_x @ state.T_r_c[:3, :3]
        J = np.zeros((len(error), 2, width))
        J[:, :, start:end] = by_v
        if k == 1:
            J[:, :, -6:] = by_x @ _turned(eye)
        P = by_left @ _turned(left) * weight
        J *= weight
        r = -error * weight[:, :, 0]
        rows = J.reshape(-1, width)
        H += rows.T @ rows
        g += rows.T @ r.ravel()
        bounds = np.searchsorted(of_camera.view, np.arange(count + 1))
        for i, (a, b) in enumerate(pairwise(bounds)):
            of_view, pose_rows, errors = J[a:b].reshape(-1, width), P[a:b].reshape(-1, 6), r[a:b].ravel()
            Hpp[i] += pose_rows.T @ pose_rows
            Hap[i] += of_view.T @ pose_rows
            gp[i] += pose_rows.T @ errors
    return H, g, list(zip(Hpp, Hap, gp))


def _reduced(H: F64, g: F64, blocks: list[_Block], damping: float) -> tuple[F64, F64]:
    S, b = H + damping * np.diag(np.diag(H)), g.copy()
    for Hpp, Hap, gp in blocks:
        W = np.linalg.solve(Hpp + damping * np.diag(np.diag(Hpp)), Hap.T).T
        S -= W @ Hap.T
        b -= W @ gp
    return S, b


def _step(H: F64, g: F64, blocks: list[_Block], damping: float, free: Bool) -> tuple[F64, list[F64]]:
    S, b = _reduced(H, g, blocks, damping)
    step = np.zeros(len(b))
    step[free] = np.linalg.lstsq(S[np.ix_(free, free)], b[free], rcond=None)[0]
    moves: list[F64] = []
    for Hpp, Hap, gp in blocks:
        move = np.linalg.solve(Hpp + damping * np.diag(np.diag(Hpp)), gp - Hap.T @ step)
        moves.append(np.asarray(move, np.float64))
    return step, moves


def _residuals(points_m: F64, views: Sequence[View], state: _State, lens: Lens, camera: int) -> Residuals:
    seen = _seen(points_m, views, len(state.v))[camera]
    _, eye = _in_eye(state, camera, seen)
    return Residuals(seen.px, project(lens, state.v[camera], eye) - seen.px, seen.view)


def _view_rms(points_m: F64, views: Sequence[View], state: _State, lens: Lens) -> F64:
    square, count = np.zeros(len(views)), np.zeros(len(views))
    for k in range(len(state.v)):
        r = _residuals(points_m, views, state, lens, k)
        np.add.at(square, r.view, (r.error_px**2).sum(1))
        np.add.at(count, r.view, 1.0)
    return np.sqrt(square / np.maximum(count, 1.0))
