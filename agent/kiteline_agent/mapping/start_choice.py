"""Chooses how a map of one camera begins: by a window of images and IMU, or by two views."""

from kiteline_agent.initialisation.inertial_start import InertialStart
from kiteline_agent.mapping.camera_state import CameraState

_WINDOW_S = 5.0  # s of an odometer after which two views begin the first map, if no window has told the scale
_CONTRADICTED_S = 15.0  # s, the same where it contradicts the window: the IMU may tell the scale alone


class StartChoice:
    """Ask `awaits_window` in each frame without a map."""

    def __init__(self, camera: CameraState, inertial: InertialStart | None, *, has_time: bool) -> None:
        """inertial: None without an IMU, or where cameras measure depth. has_time: no CPU budget slows windows down."""
        self._camera, self._inertial, self._has_time = camera, inertial, has_time
        self._since_ns: int | None = None  # stamp of the first frame with IMU and odometer

    def awaits_window(self, t_ns: int) -> bool:
        """True if a map begins by images and IMU at a frame. An odometer tells lengths beside them.

        It leads over a loss by itself: then two views begin a map at once, as without samples of an IMU. So they do
        under a CPU budget, by which a window takes longer than an odometer that tells their unit.
        """
        if self._inertial is None or not self._camera.motion.odometer.has_recent(t_ns):
            return self._inertial is not None
        if self._camera.submaps.any or not (self._inertial.has_samples and self._has_time):
            return False
        self._since_ns = t_ns if self._since_ns is None else self._since_ns
        most_s = _CONTRADICTED_S if self._inertial.odometry.contradicts else _WINDOW_S
        return t_ns - self._since_ns < most_s * 1e9
