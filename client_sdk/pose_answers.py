"""Answer the pose queries of a tracker by a robot's service ``pnp``."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from client_sdk.commands.answer_types import PoseAnswer
from client_sdk.frontend import PoseQuery
from rse_pf.pnp import PnpOptions

__all__ = ["AskPose", "ask_robot"]

AskPose = Callable[[PoseQuery], Awaitable[PoseAnswer]]
"""Function that answers one pose query.

If the function raises an RsePfError, the query counts as not answered.  `Mapper.track` passes on a
ConfigurationError (such as a UsageError) and every exception that is no RsePfError.
"""


def ask_robot(solve_pnp: Callable[..., Awaitable[PoseAnswer]], deadline_s: float | None = None) -> AskPose:
    """Return a function that answers pose queries with `Robot.solve_pnp`, each within *deadline_s* seconds.

    None means ``session.answer_timeout_s``.  Queries have ``keep``: newer ones do not replace a query.
    """

    async def ask(query: PoseQuery) -> PoseAnswer:
        correspondences = query.correspondences
        return await solve_pnp(
            correspondences.points_world,
            correspondences.pixels,
            query.camera,
            PnpOptions(inlier_px=query.inlier_px, max_iterations=query.max_iterations),
            depths_m=correspondences.depths_m if correspondences.depths_m.any() else None,
            depth_noise=query.depth_noise,
            deadline_s=deadline_s,
            keep=True,
        )

    return ask
