"""What a camera saw before its map in metres began, for the base: some of the window's keyframes.

The tracker goes on from the newest keyframe and has no use for them. Other agents may only have seen this place, and a
base merges what it has keyframes of. The window's own corners are too few and too unlike those of other keyframes to be
recognised, so that each image is searched for corners as any keyframe's is.
"""

import numpy as np

from kiteline_agent.config import AgentConfig
from kiteline_agent.imaging import features
from kiteline_agent.imaging.feature_kernels import BORDER
from kiteline_agent.imaging.features import DetectorConfig
from kiteline_agent.initialisation.inertial_map import InertialMap
from kiteline_agent.initialisation.window import lens_correction
from kiteline_agent.keyframes.new_landmarks import EarlierView, NewPoints
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.geometry.cameras import RectifiedCamera

# Of the keyframe policy's distance. No tracking ties these keyframes to others, but descriptors alone: on a real flight
# they agree for 36 % of the corners from 2 % of the depth away, for 25 % from 6 % and for 19 % from 12 %.
_CLOSER = 0.5


def earlier_views(
    found: InertialMap, camera: RectifiedCamera, config: AgentConfig, gap_ns: int
) -> tuple[EarlierView, ...]:
    """The window's oldest keyframe, then each that is far enough from the one chosen before it.

    gap_ns: time between two keyframes for which the link has room.
    """
    state, keyframes = found.solution.state, found.keyframes
    T_w_k = np.tile(np.eye(4), (len(keyframes), 1, 1))
    T_w_k[:, :3, :3], T_w_k[:, :3, 3] = state.R, state.p
    T_w_k = T_w_k @ camera.T_b_c
    far_m = _CLOSER * config.keyframe.baseline_ratio * found.points.median_depth_m(camera)
    chosen = [0]
    for k in range(1, len(keyframes) - 1):
        T = se3.inverse(T_w_k[chosen[-1]]) @ T_w_k[k]
        turned = float(np.linalg.norm(se3.so3_log(T[:3, :3])))
        new = float(np.linalg.norm(T[:3, 3])) > far_m or turned > config.keyframe.rotation_rad
        if new and keyframes[k].t_ns - keyframes[chosen[-1]].t_ns >= gap_ns:
            chosen.append(k)
    T_n_w = se3.inverse(T_w_k[-1])
    return tuple(_view(found, k, se3.orthonormalise(T_n_w @ T_w_k[k]), camera, config.detector) for k in chosen)


def _view(found: InertialMap, k: int, T_n_k: F64, camera: RectifiedCamera, detector: DetectorConfig) -> EarlierView:
    keyframe, corners = found.keyframes[k], found.corners
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    uv, margin = corners.xy[k] * focal + centre, BORDER + 1.0
    inside = (uv > margin).all(axis=1) & (uv < np.array([camera.width, camera.height]) - margin).all(axis=1)
    followed = np.flatnonzero(corners.seen[k] & inside)
    followed = followed[np.argsort(corners.ids[followed])]
    more = features.detect(keyframe.left, uv[followed], detector)
    uv = np.concatenate([uv[followed], more.uv])
    octave = np.concatenate([np.zeros(len(followed), np.uint8), more.octave])
    angle, descriptor = features.describe(keyframe.left, uv, octave)
    true = lens_correction.true_place((uv - centre) / focal, found.lens) * focal + centre
    if found.shutters:  # depths of most corners are not known here
        true = found.shutters[k].to_frame(true, np.full(len(true), 1.0 / found.points.median_depth_m(camera)))[:, :2]
    ids = np.concatenate([corners.ids[followed], np.full(len(more.uv), -1, np.int64)])
    return EarlierView(keyframe.t_ns, T_n_k, NewPoints(true, np.full(len(uv), -1.0), octave, angle, descriptor), ids)
