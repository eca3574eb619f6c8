"""One ROS 2 node with its thread: topics in, messages to callbacks. Everything that touches rclpy."""

import contextlib
import importlib
import threading
from collections.abc import Callable
from typing import Any

from kiteline_hw.cameras.camera import CameraError

_SPIN_S = 0.1  # s that the thread waits for a message at most: it ends as soon after `close`
_FAILED_S = 0.01  # s after an error: one that lasts must not take a processor
MISSING = (
    "ROS 2 is not there (rclpy and sensor_msgs cannot be imported: {}): `apt install ros-DISTRO-rclpy "
    "ros-DISTRO-sensor-msgs`, then `source /opt/ros/DISTRO/setup.bash` before kiteline, which must run in ROS's Python "
    "(a virtual environment made with --system-site-packages)"
)


class RosNode:
    """A node in a context of its own. Raises CameraError where ROS 2 is missing or cannot be started."""

    def __init__(self) -> None:
        try:
            self._rclpy: Any = importlib.import_module("rclpy")
            executors: Any = importlib.import_module("rclpy.executors")
            self._qos: Any = importlib.import_module("rclpy.qos").qos_profile_sensor_data
            self.types: Any = importlib.import_module("sensor_msgs.msg")
        except ImportError as error:
            raise CameraError(MISSING.format(error), passing=False) from error
        try:
            self._context = self._rclpy.context.Context()
            self._rclpy.init(context=self._context)
            self._node = self._rclpy.create_node("kiteline", context=self._context)
            self._executor = executors.SingleThreadedExecutor(context=self._context)
            self._executor.add_node(self._node)
        except Exception as error:  # rclpy documents none; the middleware underneath has its own
            text = f"ROS 2 cannot be started ({error}): does `ros2 topic list` work in this shell?"
            raise CameraError(text, passing=False) from error
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._spin, name="ros2", daemon=True)
        self._thread.start()

    def subscribe(self, kind: Any, topic: str, callback: Callable[[Any], None]) -> Any:
        """Call back with each message of a topic, from the node's thread; what `unsubscribe` takes."""
        with self._lock:
            return self._node.create_subscription(kind, topic, callback, self._qos)

    def unsubscribe(self, subscription: Any) -> None:
        """End a subscription."""
        with self._lock, contextlib.suppress(Exception):
            self._node.destroy_subscription(subscription)

    def publishers(self, topic: str) -> int:
        """How many publish a topic."""
        with self._lock:
            return int(self._node.count_publishers(topic))

    def _spin(self) -> None:
        while not self._closed.is_set():
            try:
                self._executor.spin_once(timeout_sec=_SPIN_S)
            except Exception:  # a message that cannot be decoded: the next one may be; a context that was shut down
                self._closed.wait(_FAILED_S)

    def close(self) -> None:
        """End node and thread, within a second. May be called twice."""
        if self._closed.is_set():
            return
        self._closed.set()
        self._thread.join(1.0)
        with contextlib.suppress(Exception):
            self._executor.shutdown()
            self._node.destroy_node()
            self._rclpy.shutdown(context=self._context)
