"""Tell ROS bags from other recordings by their names; `client_sdk.bags` reads them."""

from __future__ import annotations

from pathlib import Path

__all__ = ["BAG_ENDINGS", "is_bag", "only_bag_of"]

BAG_ENDINGS = (".bag", ".db3", ".mcap")
"""Endings of bag files: ROS 1, and the two storage formats of ROS 2."""


def is_bag(path: Path) -> bool:
    """Return whether a path is a ROS bag: a bag file, or a folder of one or with ``metadata.yaml``."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file() or only_bag_of(path) is not None
    return path.suffix in BAG_ENDINGS


def only_bag_of(folder: Path) -> Path | None:
    """Return the only file in a folder with the ending of a bag; None for no such file, or several."""
    bag_paths = [path for path in folder.iterdir() if path.suffix in BAG_ENDINGS and path.is_file()]
    return bag_paths[0] if len(bag_paths) == 1 else None
