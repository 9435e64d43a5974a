"""Programs of ROS 2 for its tests: the bridge, a listener and a player, in a domain of their own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tests.kit.ros_programs import Program, RosPrograms

__all__ = ["COLOUR", "DOMAIN", "ROS2", "Ros2", "all_is_played"]

_ROOT = Path(__file__).parents[2]
ROS2 = _ROOT / "build" / "ros2"
_PROFILE = _ROOT / "ros_bridge/packages/rse_pf_bridge/config/fastdds.xml"
DOMAIN = 86
COLOUR = "/camera/image_raw"
_TOPICS = {"colour": COLOUR, "depth": "/camera/aligned_depth", "info": "/camera/camera_info"}


class Ros2(RosPrograms):
    """Programs of one domain of ROS 2 on this machine."""

    shell = "ros2"
    listener_file = "ros2_listener.py"

    def __init__(self, folder: Path, domain: int = DOMAIN) -> None:
        env = {
            "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
            "FASTDDS_DEFAULT_PROFILES_FILE": str(_PROFILE),
            "ROS_HOME": str(folder), "PYTHONUNBUFFERED": "1",
        }  # fmt: skip
        super().__init__(str(ROS2 / "bin" / "python"), _TOPICS, env)

    def play(self, bag: Path, rate: float = 1.0, robots: int = 1) -> Program:
        """Play when each robot's bridge takes each topic, and its listener the colours."""
        wanted = {topic: robots * (2 if topic == COLOUR else 1) for topic in _TOPICS.values()}
        return self.play_for(bag, wanted, rate)

    def play_for(self, bag: Path, wanted: Mapping[str, int], rate: float = 1.0) -> Program:
        """Play when each topic has so many subscribers."""
        words = ["--rate", str(rate), "--wait", *(f"{topic}={many}" for topic, many in wanted.items())]
        return self.start(self.python, str(_ROOT / "examples/robots/ros2_play_bag.py"), str(bag), *words)


def all_is_played(lines: list[str]) -> bool:
    """Return whether a player has ended."""
    return bool(lines) and lines[-1].endswith("messages played\n")
