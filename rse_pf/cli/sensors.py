"""The options that say which sensors of a drive are used, and whether it is checked."""

from __future__ import annotations

import argparse
from typing import Any

__all__ = ["add_check_argument", "add_sensor_arguments"]


def add_sensor_arguments(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Declare the options; None means what the recording has."""
    add: Any = parser.add_argument
    add(
        "--camera", choices=("stereo", "left"),
        help="both cameras of a rig, or the left one alone (default: both where there are two)",
    )  # fmt: skip
    add(
        "--imu", action=argparse.BooleanOptionalAction, default=None,
        help="use the IMU, or do not (default: where there is one)",
    )  # fmt: skip


def add_check_argument(parser: argparse.ArgumentParser) -> None:
    """Declare ``--no-check``."""
    parser.add_argument(
        "--no-check", dest="check", action="store_false", help="do not check calibration, times and images"
    )
