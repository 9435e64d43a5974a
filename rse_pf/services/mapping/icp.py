"""The service ``icp``: refine the relative pose of two overlapping point clouds from an initial guess."""

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
"""Most points of one cloud of a request, which bounds the time and memory of an alignment; a request with a
larger cloud is refused with LimitExceeded."""
_MAX_VOXELS = 500_000
"""Largest distance of a point, or of the initial position, from the origin along an axis, in voxels; a
request beyond it is refused with BadRequest.  The voxel indices of small_gicp have 21 bits for each axis, and
so reach 2^20 (1,048,576) voxels to either side; about half of them is a margin for the motion of the source
cloud."""


class IcpRequest(msgspec.Struct, frozen=True, kw_only=True):
    """Two point clouds with an initial guess of their relative pose.

    Attributes:
        target: ``3n`` coordinates of the fixed cloud, metres, row by row.
        source: ``3m`` coordinates of the cloud that is moved, metres, row by row.
        T_target_source: 16 numbers, row-major, the initial guess, which maps source to target points.
        options: Options of the alignment; None for the defaults.
    """

    target: Array
    source: Array
    T_target_source: Array
    options: IcpOptions | None = None


class IcpReply(msgspec.Struct, frozen=True, kw_only=True):
    """A relative pose with its evidence.

    Attributes:
        T_target_source: 16 numbers, row-major: the refined pose; the guess of the request where it is
            refused.
        verdict: ``ok`` or ``refused``.
        reason: Why the refined pose is refused, empty if it is not: ``worse`` (it fits worse than the guess),
            ``poor-fit`` (the surfaces do not fit), ``little-overlap``, ``sliding`` (the surfaces do not
            constrain the pose), ``jumped`` (it is too far from the guess) or ``not-converged``.
        overlap: Share of the source points with a correspondence at the refined pose, 0..1.
        misfit_before_m: Mean distance of source points to the target's surface at the guess, metres.
        misfit_after_m: Mean distance of source points to the target's surface at the refined pose, metres.
        iterations: Iterations of the registration.
    """

    T_target_source: Array
    verdict: str
    reason: str
    overlap: float
    misfit_before_m: float
    misfit_after_m: float
    iterations: int


def register(registry: Registry) -> None:
    """Add the service ``icp`` to *registry*."""

    @registry.service("icp", limited=True, warm_up=load_small_gicp)
    def icp(request: IcpRequest) -> IcpReply:
        """Refine the pose between two overlapping point clouds.

        If the refined pose is refused, the reply has the guess of the request and the reason.
        """
        target = reshaped("target", request.target, 3)
        source = reshaped("source", request.source, 3)
        if max(len(target), len(source)) > MAX_POINTS:
            raise LimitExceeded(f"a cloud has more than {MAX_POINTS} points", hint="thin it to voxels first")
        _check_extent(request)
        numbers = np.asarray(request.T_target_source, dtype=np.float64)
        guess = rigid(numbers.reshape(4, 4)) if numbers.size == 16 else None
        if guess is None:
            raise BadRequest("T_target_source is not a rigid motion", hint="send 16 numbers, row-major")
        aligned = align_clouds(target, source, guess, request.options)
        return IcpReply(
            T_target_source=aligned.T_target_source.ravel(),
            verdict=aligned.verdict,
            reason=aligned.reason,
            overlap=aligned.overlap,
            misfit_before_m=aligned.misfit_before_m,
            misfit_after_m=aligned.misfit_after_m,
            iterations=aligned.iterations,
        )


def _check_extent(request: IcpRequest) -> None:
    """Raise BadRequest if a coordinate of a cloud or the initial pose is too many voxels from the origin."""
    voxel_m = (request.options or IcpOptions()).voxel_m
    arrays = (request.target, request.source, request.T_target_source)
    extent_m = max(float(np.abs(array).max(initial=0.0)) for array in arrays)
    if extent_m > _MAX_VOXELS * voxel_m:
        raise BadRequest(
            f"a coordinate of {extent_m:g} m is above {_MAX_VOXELS * voxel_m:g} m, {_MAX_VOXELS} voxels",
            hint="send metres near the origin, or a larger voxel_m",
        )
