"""The connections of one worker to the owners of live maps, wherever they run.

A worker finds the owner of a map through its lease in the store, and starts one when there is none or when it
has stopped.  Requests may be repeated on a new connection: every operation can be done twice without harm.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from rse_pf.backend.live_map.children import OwnerChild, OwnerChildren
from rse_pf.backend.live_map.map_link import LinkContext, MapLink
from rse_pf.backend.live_map.owner.lease import decode_lease, lease_name, tenant_folder
from rse_pf.backend.live_map.owner.link_security import internal_key
from rse_pf.backend.live_map.owner.process import MAP_KIND, OwnerProcess
from rse_pf.backend.log import JsonLog
from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest, NotFound
from rse_pf.identity import RobotId
from rse_pf.object_store import ObjectStore
from rse_pf.wire.live_map import LiveRequest

__all__ = ["OwnerLinks"]

_THREADS = 4
"""They wait for the store: for the leases of the maps that have no owner now."""
_RELEASE_S = 5.0
_STATES = {"serving": "live", "starting": "moving", "released": "idle", "stopped": "stopped"}


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
        kind: str = MAP_KIND,
    ) -> None:
        """Connect to nobody yet.

        Args:
            store: Shared by all servers.
            settings: Of the platform.
            server_id: Of this server.
            loop: Event loop of the worker.
            log: Of the worker.
            on_update: Called with tenant, map and payload of each update of a watched map.
            kind: The logic of the maps, as ``module:name`` of a `MapKind`.
        """
        self._store = store
        self._settings = settings
        self._loop = loop
        self._on_update = on_update
        self._links: dict[tuple[str, str], MapLink] = {}
        self._key: bytes | None = None
        self._threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="live-link")
        self._children = OwnerChildren(
            lambda calmly: OwnerProcess(settings, kind, calmly=calmly),
            max_owners=settings.live.max_owners,
            keeps_spare=settings.live.warm_standby,
        )
        self._context = LinkContext(
            store=store,
            settings=settings.live,
            server_id=server_id,
            log=log,
            call=lambda act: loop.run_in_executor(self._threads, act),
            key=self._internal_key,
            children=self._children,
            clock=time.monotonic,
            wall_clock=time.time,
        )

    async def request(
        self,
        tenant: str,
        map_name: str,
        robot: RobotId,
        operation: str,
        request: LiveRequest,
        deadline_s: float,
    ) -> dict[str, Any]:
        """Return the answer of the map's owner to a command.

        Args:
            tenant: Of the robot.
            map_name: Of the live map.
            robot: Who asks.
            operation: The service, such as ``live-keyframe``.
            request: Of the command; the owner checks it.
            deadline_s: Seconds from now on.

        Raises:
            Busy: The map has no owner in time; ``retry_after_ms`` says when to ask again.
            RsePfError: What the owner refused: Conflict, BadRequest, NotFound, Forbidden.
        """
        link = self._link(tenant, map_name)
        self._children.use(is_used=True)
        return await link.request(robot, operation, request, deadline_s)

    async def list_maps(self, tenant: str) -> list[dict[str, Any]]:
        """Return name, state, owner and server of each live map of *tenant*, from the store alone."""
        listed: list[dict[str, Any]] = await self._context.call(lambda: self._list(tenant))
        return listed

    def watch(self, tenant: str, map_name: str, *, may_start: bool = True) -> None:
        """Ask for the updates of a map; the present state comes first, and again from each new owner.

        Args:
            tenant: Whose map.
            map_name: Its name.
            may_start: Whether an owner is started for that if the map has none.
        """
        self._link(tenant, map_name).set_watched(True, may_start=may_start)
        self._keep_spare()

    def unwatch(self, tenant: str, map_name: str) -> None:
        """Ask for no more updates of a map."""
        link = self._links.get((tenant, map_name))
        if link is not None:
            link.set_watched(False)
            self._keep_spare()

    def give_up(self) -> None:
        """Let the owners that this worker started release their leases: the server drains."""
        self._children.release()

    @property
    def children(self) -> list[OwnerChild]:
        """The owner processes that this worker has started and that claim or serve a map."""
        return self._children.used

    async def close(self) -> None:
        """Release the leases of the owners that this worker started, and close all connections."""
        self.give_up()
        children = [child.ended for child in self._children.used]
        if children:
            await asyncio.wait(children, timeout=_RELEASE_S)
        for link in list(self._links.values()):
            await link.close()
        self._threads.shutdown(wait=False)

    def _link(self, tenant: str, map_name: str) -> MapLink:
        """Return the link of a map; raises BadRequest."""
        if self._settings.data.store == "memory:":
            raise BadRequest("live maps need a store that all servers share", hint="set data.store")
        link = self._links.get((tenant, map_name))
        if link is None:
            link = self._links[tenant, map_name] = MapLink(
                self._context, tenant, map_name,
                on_update=lambda payload: self._on_update(tenant, map_name, payload), on_end=self._forget,
            )  # fmt: skip
        return link

    def _keep_spare(self) -> None:
        """Keep a process ready while some map may need it."""
        self._children.use(is_used=any(link.is_in_use for link in self._links.values()))

    def _forget(self, link: MapLink) -> None:
        self._links.pop((link.tenant, link.map_name), None)
        self._keep_spare()

    def _internal_key(self) -> bytes:
        if self._key is None:
            self._key = internal_key(self._store)
        return self._key

    def _list(self, tenant: str) -> list[dict[str, Any]]:
        found = []
        for name in self._store.folders(tenant_folder(tenant)):
            object_name = lease_name(tenant, name)
            try:
                record = decode_lease(object_name, self._store.get(object_name))
            except NotFound:
                continue
            found.append(
                {"name": name, "state": _STATES[record.state], "owner": record.owner, "server": record.server}
            )
        return found
