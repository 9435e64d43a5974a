"""The shell of ROS 2 where a part of ROS 2 is missing; with a real one see test_ros2."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from ros_bridge.options import BridgeOptions
from ros_bridge.outgoing import advertised
from ros_bridge.ros2_node import publishers_of


def test_a_topic_whose_type_is_not_installed_is_left_out_and_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    options = BridgeOptions()
    for _, kind, _ in advertised(options):
        package, _, name = kind.partition("/msg/")
        if package != "tf2_msgs":
            module = sys.modules.get(f"{package}.msg", ModuleType(f"{package}.msg"))
            setattr(module, name, kind)
            monkeypatch.setitem(sys.modules, package, ModuleType(package))
            monkeypatch.setitem(sys.modules, f"{package}.msg", module)
    monkeypatch.setitem(sys.modules, "tf2_msgs", None)
    policies = SimpleNamespace(KEEP_LAST=1, BEST_EFFORT=2, RELIABLE=3, TRANSIENT_LOCAL=4, VOLATILE=5)
    qos = ModuleType("rclpy.qos")
    qos.QoSProfile = lambda **policy: policy  # type: ignore[attr-defined]
    for name in ("HistoryPolicy", "ReliabilityPolicy", "DurabilityPolicy"):
        setattr(qos, name, policies)
    monkeypatch.setitem(sys.modules, "rclpy", ModuleType("rclpy"))
    monkeypatch.setitem(sys.modules, "rclpy.qos", qos)
    made: dict[str, Any] = {}
    node = SimpleNamespace(create_publisher=lambda kind, topic, quality: made.setdefault(topic, kind))

    publishers = publishers_of(node, options)

    assert publishers.keys() == {topic for topic, _, _ in advertised(options)} - {"/tf"}
    assert made["/rse_pf/pose"] == "geometry_msgs/msg/PoseWithCovarianceStamped"
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    assert "/tf is not published: tf2_msgs is not installed (apt install ros-$ROS_DISTRO-tf2-msgs)" in out
