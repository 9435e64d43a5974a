"""Format the figures of a drive as text, for the verbs demo and map."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["accuracy_lines", "lost_line", "offset_lines"]


def lost_line(report: Mapping[str, Any]) -> str:
    """Return the text with the number of lost frames, and of those before a monocular robot's first pose."""
    before = report["frames_before_start"]
    return f"{report['lost_frames']} lost" + (f", {before} before the start" if before else "")


def offset_lines(report: Mapping[str, Any]) -> list[str]:
    """Return the line about an offset of the disparity that was corrected when a stereo drive was saved.

    An empty list if none was found.
    """
    offset_px, deviation_px = (report.get(f"disparity_offset{each}_px") for each in ("", "_deviation"))
    if not offset_px:
        return []
    return [
        f"the calibration lacks {offset_px:.2f} +- {deviation_px:.2f} px of disparity: saving corrected "
        "path, keyframes and cloud; check speaks of the drive before that"
    ]


def accuracy_lines(report: Mapping[str, Any]) -> list[str]:
    """Return the line with ATE and RPE (cm) of *report*; an empty list without true poses or metric scale."""
    if report.get("ate_cm") is None:
        return []
    rpe = "" if report["rpe_cm"] is None else f", RPE {report['rpe_cm']:.2f} cm"
    return [f"error beside the {report['truth']}: ATE {report['ate_cm']:.2f} cm{rpe}"]
