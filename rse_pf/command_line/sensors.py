"""The options that say which sensors of a drive are used, and whether it is checked; lines on its source."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from client_sdk.source_facts import Doubt
from rse_pf.command_line.options import option
from rse_pf.terminal import show

__all__ = ["AcceptRequest", "CheckRequest", "SensorRequest", "show_source"]


@dataclass(frozen=True, kw_only=True)
class SensorRequest:
    """Which sensors of a recording are used; None means those that it has."""

    camera: Literal["stereo", "left"] | None = option(
        "--camera",
        choices=("stereo", "left"),
        help="both cameras of a stereo rig, or the left one alone (default: both where there are two)",
    )
    imu: bool | None = option(
        "--imu",
        action=argparse.BooleanOptionalAction,
        help="use the IMU, or do not (default: where there is one)",
    )


@dataclass(frozen=True, kw_only=True)
class AcceptRequest:
    """Which findings about the source of a drive are accepted."""

    accept: tuple[str, ...] = option(
        "--accept",
        action="append",
        default=(),
        metavar="NAME",
        help="accept a finding about the source: NAME stands before it, such as left-out; repeatable",
    )


@dataclass(frozen=True, kw_only=True)
class CheckRequest(AcceptRequest):
    """Whether a drive is checked while it is tracked."""

    check: bool = option("--no-check", default=True, help="do not check calibration, times and images")


def show_source(notes: Iterable[str], doubts: Iterable[Doubt]) -> tuple[str, ...]:
    """Show what was assumed about a source, and what is unlikely, before it is used.

    Returns:
        The lines of the doubts, which need not be shown again.
    """
    lines = tuple(doubt.line() for doubt in doubts)
    show(*(f"note: {note}" for note in notes), *lines, error=True)
    return lines
