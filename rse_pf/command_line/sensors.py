"""The options that say which sensors of a drive are used, and whether it is checked; lines on its source."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import Any

from client_sdk.source_facts import Doubt
from rse_pf.terminal import show

__all__ = ["add_accept_argument", "add_check_argument", "add_sensor_arguments", "show_source"]


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
    add_accept_argument(parser)


def add_accept_argument(parser: argparse.ArgumentParser) -> None:
    """Declare ``--accept``."""
    parser.add_argument(
        "--accept", action="append", default=[], metavar="NAME",
        help="take a finding about the source for right: NAME stands before it, such as left-out",
    )  # fmt: skip


def show_source(notes: Iterable[str], doubts: Iterable[Doubt]) -> tuple[str, ...]:
    """Show what was assumed about a source, and what is unlikely, before it is used.

    Returns:
        The lines of the doubts, which need not be shown again.
    """
    lines = tuple(doubt.line() for doubt in doubts)
    show(*(f"note: {note}" for note in notes), *lines, error=True)
    return lines
