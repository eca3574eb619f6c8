"""`v4l2:DEV[,DEV]`: one camera, two, or one whose images hold both views side by side (`?side_by_side=1`)."""

from kiteline_hw.calibration.file_calibration import FileCalibration
from kiteline_hw.cameras import live_options
from kiteline_hw.cameras.camera import CameraError
from kiteline_hw.cameras.live_source import CameraSource
from kiteline_hw.cameras.v4l2_api import Kernel, LinuxKernel
from kiteline_hw.cameras.v4l2_camera import V4l2Camera, V4l2Settings
from kiteline_hw.ports import SourceError

KERNEL: Kernel = LinuxKernel()  # a modelled device takes its place in tests


def open_source(argument: str, mono: bool, imu: bool, given: FileCalibration | None = None) -> CameraSource:
    """Open cameras. One that is away is awaited in flight; one that cannot do what is asked raises SourceError.

    given: calibration in place of the one that the options name.
    """
    del imu  # cameras come without one; `--imu controller` flies on the flight controller's
    text, options = live_options.parse("v4l2", argument)
    devices = [device for device in text.split(",") if device]
    if not 1 <= len(devices) <= 2 or (options.side_by_side and len(devices) == 2):
        raise SourceError(f"v4l2:{argument}: expected one device, or two (left,right) without side_by_side")
    stereo = (len(devices) == 2 or options.side_by_side) and not mono
    rig = live_options.read_rig("v4l2", options, stereo=stereo, given=given)
    if mono:
        devices = devices[:1]
    width = rig.left.width * (2 if options.side_by_side else 1)
    models = [rig.left, rig.right or rig.left][: len(devices)]
    cameras = [
        V4l2Camera(
            device,
            V4l2Settings(
                model.width if not options.side_by_side else width, model.height, options.fps, options.format.upper(),
                options.exposure_ms, options.gain,
            ),
            KERNEL,
        )
        for device, model in zip(devices, models, strict=True)
    ]  # fmt: skip
    for camera in cameras:
        try:
            camera.open()
        except CameraError as error:
            if not error.passing:
                raise
        finally:
            camera.close()
    return CameraSource(f"v4l2:{','.join(devices)}", rig, cameras, options.fps, options.side_by_side)
