"""The connections of one worker to the owners of live maps, wherever they run.

A worker finds the owner of a map through its lease in the store, and starts one when there is none or when it
has stopped.  Requests may be repeated on a new connection: every operation can be done twice without harm.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from rse_pf.backend.log import JsonLog
from rse_pf.config import PlatformSettings
from rse_pf.identity import RobotId
from rse_pf.object_store import ObjectStore

__all__ = ["OwnerLinks"]


class OwnerLinks:
    """The connections of one worker to the owners of the maps that its robots use.

    All methods are called in the event loop.
    """

    def __init__(
        self,
        *,
        store: ObjectStore,
        settings: PlatformSettings,
        server_id: str,
        loop: asyncio.AbstractEventLoop,
        log: JsonLog,
        on_update: Callable[[str, str, dict[str, Any]], None],
    ) -> None:
        """Connect to nobody yet.

        Args:
            store: Shared by all servers.
            settings: Of the platform.
            server_id: Of this server.
            loop: Event loop of the worker.
            log: Of the worker.
            on_update: Called with tenant, map and payload of each update of a watched map.
        """
        raise NotImplementedError

    async def request(
        self,
        tenant: str,
        map_name: str,
        robot: RobotId,
        operation: str,
        payload: dict[str, Any],
        deadline_s: float,
    ) -> dict[str, Any]:
        """Return the answer of the map's owner to a command.

        Args:
            tenant: Of the robot.
            map_name: Of the live map.
            robot: Who asks.
            operation: The service, such as ``live-keyframe``.
            payload: Of the command; the owner checks it.
            deadline_s: Seconds from now on.

        Raises:
            Busy: The map has no owner in time; ``retry_after_ms`` says when to ask again.
            RsePfError: What the owner refused: Conflict, BadRequest, NotFound, Forbidden.
        """
        raise NotImplementedError

    async def list_maps(self, tenant: str) -> list[dict[str, Any]]:
        """Return name, state, owner and server of each live map of *tenant*, from the store alone."""
        raise NotImplementedError

    def watch(self, tenant: str, map_name: str) -> None:
        """Ask for the updates of a map; the present state comes first, and again from each new owner."""
        raise NotImplementedError

    def unwatch(self, tenant: str, map_name: str) -> None:
        """Ask for no more updates of a map."""
        raise NotImplementedError

    def give_up(self) -> None:
        """Let the owners that this worker started release their leases: the server drains."""
        raise NotImplementedError

    async def close(self) -> None:
        """Release the leases of the owners that this worker started, and close all connections."""
        raise NotImplementedError
