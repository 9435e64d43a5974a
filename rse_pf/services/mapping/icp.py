"""The alignment service: from two overlapping clouds and an initial guess to the pose between them."""

from __future__ import annotations

import msgspec
import numpy as np

from rse_pf.errors import BadRequest, LimitExceeded
from rse_pf.geometry import rigid
from rse_pf.service import Registry
from rse_pf.slam.icp import IcpOptions, align_clouds, load_small_gicp
from rse_pf.wire.arrays import Array, reshaped

__all__ = ["IcpReply", "IcpRequest", "register"]

MAX_POINTS = 1_000_000
"""Of one cloud."""
_MAX_VOXELS = 500_000
"""From the origin along an axis; small_gicp numbers voxels by 21 bits."""


class IcpRequest(msgspec.Struct, frozen=True, kw_only=True):
    """Two clouds, ``3n`` metres each, and ``T_target_source`` (16 numbers, row-major) to begin with."""

    target: Array
    source: Array
    T_target_source: Array
    options: IcpOptions | None = None


class IcpReply(msgspec.Struct, frozen=True, kw_only=True):
    """A pose and what speaks for it.

    ``verdict`` is ``ok``, or ``refused`` with a *reason* (worse, poor-fit, little-overlap, sliding,
    jumped, not-converged); ``T_target_source`` then is the guess of the request.
    """

    T_target_source: Array
    verdict: str
    reason: str
    overlap: float
    misfit_before_m: float
    misfit_after_m: float
    iterations: int


def register(registry: Registry) -> None:
    """Add ``icp`` to *registry*."""

    @registry.service("icp", limited=True, warm_up=load_small_gicp)
    def icp(request: IcpRequest) -> IcpReply:
        """Refine the pose between two overlapping point clouds."""
        target = reshaped("target", request.target, 3)
        source = reshaped("source", request.source, 3)
        if max(len(target), len(source)) > MAX_POINTS:
            raise LimitExceeded(f"a cloud has more than {MAX_POINTS} points", hint="thin it to voxels first")
        _check_extent(request)
        numbers = np.asarray(request.T_target_source, dtype=np.float64)
        guess = rigid(numbers.reshape(4, 4)) if numbers.size == 16 else None
        if guess is None:
            raise BadRequest("T_target_source is not a rigid motion", hint="send 16 numbers, row-major")
        found = align_clouds(target, source, guess, request.options)
        return IcpReply(
            T_target_source=found.T_target_source.ravel(),
            verdict=found.verdict,
            reason=found.reason,
            overlap=found.overlap,
            misfit_before_m=found.misfit_before_m,
            misfit_after_m=found.misfit_after_m,
            iterations=found.iterations,
        )


def _check_extent(request: IcpRequest) -> None:
    """Raise BadRequest for numbers so large that their voxels have no number."""
    voxel_m = (request.options or IcpOptions()).voxel_m
    numbers = (request.target, request.source, request.T_target_source)
    extent_m = max((float(np.abs(each).max(initial=0.0)) for each in numbers), default=0.0)
    if extent_m > _MAX_VOXELS * voxel_m:
        raise BadRequest(
            f"a coordinate of {extent_m:g} m is above {_MAX_VOXELS * voxel_m:g} m, {_MAX_VOXELS} voxels",
            hint="send metres near the origin, or a larger voxel_m",
        )
