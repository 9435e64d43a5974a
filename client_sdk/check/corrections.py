"""Apply the corrections of certain findings to the intrinsics of a camera."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from client_sdk.check.findings import FaultKind, Finding
from client_sdk.rigs.intrinsics import Intrinsics
from rse_pf.geometry import Camera

__all__ = ["corrected"]

_INTRINSICS = ("fx", "fy", "cx", "cy")  # intrinsics of the pinhole camera, px, that a correction may replace
# The lens model whose coefficient ``k1`` a correction of the distortion gives.
_CORRECTED_MODEL = "radial-tangential"


def corrected(intrinsics: Intrinsics, findings: Iterable[Finding]) -> tuple[Intrinsics, tuple[str, ...]]:
    """Return intrinsics with corrections of those *findings* that are certain, and a text on each change.

    A correction of the distortion is applied only to a radial-tangential lens without distortion: the
    estimate is ``k1`` of what remains after undistortion, which no other model or coefficient expresses.
    """
    changed: list[str] = []
    camera, lens = intrinsics.camera, intrinsics.distortion
    values = {name: getattr(camera, name) for name in _INTRINSICS}
    scale = intrinsics.depth_scale
    for finding in findings:
        if not finding.is_certain:
            continue
        for name in _INTRINSICS:
            if name in finding.correction:
                changed.append(f"{name} {values[name]:.2f} to {finding.correction[name]:.2f}")
                values[name] = finding.correction[name]
        if "k1" in finding.correction and intrinsics.model == _CORRECTED_MODEL and not any(lens):
            lens = (finding.correction["k1"], 0.0, 0.0, 0.0)
            changed.append(f"k1 0 to {lens[0]:.4f}")
        if finding.kind is FaultKind.DEPTH_SCALE:
            scale = intrinsics.depth_units_per_m / (1.0 + finding.value)
            changed.append(f"depth_scale {intrinsics.depth_units_per_m:.6g} to {scale:.6g}")
    made = Camera(**values, width=camera.width, height=camera.height)
    # The reprojection error and the number of views of the old calibration do not describe the new one.
    same = replace(intrinsics, rms_px=None, views=None) if changed else intrinsics
    return replace(same, camera=made, distortion=lens, depth_scale=scale), tuple(changed)
