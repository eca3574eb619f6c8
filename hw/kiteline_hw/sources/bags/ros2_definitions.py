"""Definitions of the ROS 2 messages that recordings are read from, for bags that hold none.

Source: the packages of common_interfaces, rcl_interfaces and geometry2; the same from ROS 2 Dashing on.
"""

import re

_HEADER = "std_msgs/Header header\n"
_MESSAGES = {
    "sensor_msgs/msg/Image": f"{_HEADER}uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
    "uint8[] data",
    "sensor_msgs/msg/CompressedImage": f"{_HEADER}string format\nuint8[] data",
    "sensor_msgs/msg/CameraInfo": f"{_HEADER}uint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\n"
    "float64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi",
    "sensor_msgs/msg/Imu": f"{_HEADER}geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
    "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
    "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance",
    "nav_msgs/msg/Odometry": f"{_HEADER}string child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
    "geometry_msgs/TwistWithCovariance twist",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "geometry_msgs/msg/TransformStamped": f"{_HEADER}string child_frame_id\ngeometry_msgs/Transform transform",
    "geometry_msgs/msg/PoseStamped": f"{_HEADER}geometry_msgs/Pose pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": f"{_HEADER}geometry_msgs/PoseWithCovariance pose",
}
_PARTS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": f"{_HEADER}string child_frame_id\ngeometry_msgs/Transform transform",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "sensor_msgs/RegionOfInterest": "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify",
}
_TYPE = re.compile(r"^(\w+/\w+)", re.MULTILINE)


def definition_of(name: str) -> str | None:
    """The definition of a message with those of its parts, as in MCAP files; None for a message that is not used."""
    own = _MESSAGES.get(name)
    if own is None:
        return None
    needed: list[str] = []
    queue = [own]
    for text in queue:
        for part in _TYPE.findall(text):
            if part not in needed:
                needed.append(part)
                queue.append(_PARTS[part])
    return "".join([own, *(f"\n{'=' * 80}\nMSG: {part}\n{_PARTS[part]}" for part in needed)]) + "\n"
