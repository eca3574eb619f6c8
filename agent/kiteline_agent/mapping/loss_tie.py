"""Tells the base how a submap that begins after a loss of images lies to the one before it."""

from dataclasses import dataclass

from kiteline_agent.mapping.camera_state import CameraState
from kiteline_agent.motion.loss_motion import LossMotion
from kiteline_codec.channel import RecordChannel
from kiteline_codec.schema import SubmapTie
from kiteline_core.arrays import F64
from kiteline_core.geometry import se3
from kiteline_core.ids import NO_KEYFRAME, KeyframeId, SubmapId


@dataclass(frozen=True, slots=True)
class _Loss:
    """The loss of images before the newest submap.

    since: the last keyframe before it. T_k_c: (4,4) camera in that keyframe when images were lost, by dead reckoning to
    the submap's first frame. R_m_c: (3,3) camera in the submap at that frame.
    """

    since: KeyframeId
    T_k_c: F64
    submap: SubmapId
    R_m_c: F64


class LossTie:
    """Call `begin` when a submap was opened after a loss, and `update` in its frames."""

    def __init__(self, camera: CameraState, channel: RecordChannel) -> None:
        self._camera, self._channel = camera, channel
        self._loss: _Loss | None = None

    def begin(self, t_ns: int, since: KeyframeId, T_k_c: F64, submap: SubmapId, R_o_m: F64) -> None:
        """Share the motion by the IMU from a keyframe to this first frame. R_o_m: (3,3) of the old submap."""
        camera = self._camera
        if camera.motion.loss_motion is not None:
            self._loss = _Loss(since, T_k_c, submap, camera.pose.T_m_c[:3, :3].copy())
            self._share(self._loss, camera.motion.loss_motion.begin(t_ns, camera.T_m_b, R_o_m))

    def update(self, t_ns: int) -> None:
        """Share it again, once images in the new submap have shown the velocity."""
        estimator, loss = self._camera.motion.loss_motion, self._loss
        if estimator is not None and loss is not None and self._camera.submaps.active == loss.submap:
            self._share(loss, estimator.update(t_ns, self._camera.T_m_b))

    def _share(self, loss: _Loss, motion: LossMotion | None) -> None:
        if motion is not None:
            T_k_f = loss.T_k_c.copy()
            T_k_f[:3, 3] += loss.T_k_c[:3, :3] @ loss.R_m_c.T @ motion.shift
            self.share(loss.submap, loss.since, T_k_f, motion.sigma_m, motion.sigma_rad)

    def share(self, submap: SubmapId, since: KeyframeId, T_k_f: F64, sigma_m: float, sigma_rad: float) -> None:
        """Share where a submap's first keyframe lies in one before the loss: T_k_f (4,4), and its deviations."""
        if since != NO_KEYFRAME:
            self._channel.put(SubmapTie(submap, since, se3.orthonormalise(T_k_f), sigma_m, sigma_rad))
