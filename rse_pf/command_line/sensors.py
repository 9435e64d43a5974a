"""Options that select the sensors of a recording and the checks of a drive, and the notes on its source."""

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
    """Options that select the sensors of a recording; None uses all that it has."""

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
    """The option that accepts findings about the source of a drive, so that they are no longer reported."""

    accept: tuple[str, ...] = option(
        "--accept",
        action="append",
        default=(),
        metavar="NAME",
        help="accept a finding about the source: NAME stands before it, such as left-out; repeatable",
    )


@dataclass(frozen=True, kw_only=True)
class CheckRequest(AcceptRequest):
    """The option that switches off the checks of a drive while it is tracked, and the accepted findings."""

    check: bool = option("--no-check", default=True, help="do not check calibration, times and images")


def show_source(notes: Iterable[str], doubts: Iterable[Doubt]) -> tuple[str, ...]:
    """Write the notes on what was assumed about a source, and the findings about it, to standard error.

    Returns:
        The lines of the findings (*doubts*) that were written, so that they are not shown again.
    """
    lines = tuple(doubt.line() for doubt in doubts)
    show(*(f"note: {note}" for note in notes), *lines, error=True)
    return lines
