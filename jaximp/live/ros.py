"""ROS 2: joint states of a robot, where `rclpy` exists. ROS installs it, and no package index."""

from __future__ import annotations

from typing import Any

from jaximp.live.clock import Batch
from jaximp.live.sources import Pushed


class RosSource:
    """Position and effort of one joint in a topic of `sensor_msgs/JointState`."""

    unreadable = 0

    def __init__(self, topic: str = "/joint_states", joint: str | None = None):
        """**Arguments:** `joint` by its name; without it the first.

        **Raises:** `ValueError` where there is no ROS 2.
        """
        try:
            import rclpy
            from rclpy.context import Context
            from rclpy.executors import SingleThreadedExecutor
            from sensor_msgs.msg import JointState
        except ImportError:
            raise ValueError(
                "joint states need ROS 2: source its setup file, and use a Python environment that sees rclpy"
            ) from None
        self._joint, self._pushed = joint, Pushed()
        self._context = Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("jaximp_monitor", context=self._context)
        self._node.create_subscription(JointState, topic, self._take, 1000)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)

    @property
    def lost(self) -> int:
        return self._pushed.lost

    def _take(self, message: Any) -> None:
        names = list(message.name)
        k = 0 if self._joint is None else names.index(self._joint) if self._joint in names else -1
        if not 0 <= k < min(len(message.position), len(message.effort)):
            self.unreadable += 1
            return
        stamp = message.header.stamp
        self._pushed.push(stamp.sec + 1e-9 * stamp.nanosec, message.position[k], message.effort[k])

    def read(self, timeout: float) -> Batch | None:
        self._executor.spin_once(timeout_sec=timeout)
        return self._pushed.read(0.0)

    def close(self) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()
