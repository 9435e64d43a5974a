"""Use the live maps of all tenants from one process: send requests and subscribe to updates.

The client keeps one `MapConnection` for each map in use, and the map-server processes that it started.
"""

from __future__ import annotations

import asyncio
import functools
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest
from rse_pf.identity import RobotId
from rse_pf.server.live_map.connection_security import internal_key
from rse_pf.server.live_map.lease import decode_lease, lease_name, tenant_folder
from rse_pf.server.live_map.map_connection import ConnectionContext, MapConnection
from rse_pf.server.live_map.process_pool import (
    DEFAULT_IMPLEMENTATION,
    MapServerPool,
    MapServerProcess,
    start_map_server,
)
from rse_pf.server.log import JsonLog
from rse_pf.storage.lease import Lease
from rse_pf.storage.object_store import ObjectStore
from rse_pf.wire.live_map import LiveRequest

__all__ = ["LiveMapClient"]

_STORE_THREADS = 4
"""Number of threads in which a worker waits for the object store, so that it reads the leases of up to four
live maps at the same time."""
_RELEASE_TIMEOUT_S = 5.0
"""Seconds for which a worker that shuts down waits until its map servers have released their maps; after that
time the worker exits, and Linux kills these map servers."""
_LISTED_STATES = {"serving": "live", "starting": "moving", "released": "idle", "stopped": "stopped"}
"""State of a map in the reply of ``live-list``, for each state of its lease: ``live`` while a map server
answers requests, ``moving`` while a map server restores the map, ``idle`` without a map server, ``stopped``
after ``live-stop``."""


class LiveMapClient:
    """The live maps as one process uses them: a worker of a server, or ``rse-pf map live``.

    A live map exists from its first request that begins it (`can_begin_map`) until ``live-stop``.  All
    methods are called in the event loop.
    """

    def __init__(
        self,
        *,
        store: ObjectStore,
        settings: PlatformSettings,
        server_id: str,
        log: JsonLog,
        on_update: Callable[[str, str, dict[str, Any]], None],
        implementation: str = DEFAULT_IMPLEMENTATION,
    ) -> None:
        """Prepare; no lease is read and no process is started before the first request or subscriber.

        Args:
            store: Object store that all servers share.
            settings: Settings of the platform.
            server_id: Id of this backend server.
            log: Log of the worker.
            on_update: Called with tenant, map name and payload of each update of a watched map.
            implementation: Import path of the `MapImplementation`, as ``module:name``.
        """
        self._store = store
        self._settings = settings
        self._on_update = on_update
        self._connections: dict[tuple[str, str], MapConnection] = {}  # keyed by tenant and map name
        self._threads = ThreadPoolExecutor(_STORE_THREADS, thread_name_prefix="live-link")
        self._pool = MapServerPool(
            lambda at_low_priority: start_map_server(
                settings, implementation, at_low_priority=at_low_priority
            ),
            max_processes=settings.live.max_owners,
            keeps_spare=settings.live.warm_standby,
        )
        self._context = ConnectionContext(
            store=store,
            settings=settings.live,
            server_id=server_id,
            log=log,
            call=lambda act: asyncio.get_running_loop().run_in_executor(self._threads, act),
            key=functools.cache(lambda: internal_key(store)),
            pool=self._pool,
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
        """Send a request to the map server of a live map and return its reply.

        A map server is started if the map has none.

        Args:
            tenant: Tenant of the robot.
            map_name: Name of the live map.
            robot: Robot that asks.
            operation: Name of the service, such as ``live-keyframe``.
            request: The request; the map server validates it.
            deadline_s: Seconds from now on within which the reply must arrive.

        Raises:
            Busy: The map has no map server in time; ``retry_after_ms`` says when to ask again.
            BadRequest: *map_name* is not valid, or the object store is not shared between servers.
            RsePfError: The map server refused the request, or the map does not exist or was stopped.
        """
        connection = self._connection(tenant, map_name)
        self._pool.set_used(is_used=True)
        return await connection.request(robot, operation, request, deadline_s)

    async def list_maps(self, tenant: str) -> list[dict[str, Any]]:
        """Return the fields of ``live-list`` for each live map of *tenant*, from its lease in the store.

        ``name`` is the name of the map, ``state`` one of the values of `_LISTED_STATES`, ``owner`` the name
        of the map server's process, and ``server`` the id of its backend server.  The state of a map whose
        map server was killed does not change until another process claims the map.

        Raises:
            StoreError: The store fails, or a lease is damaged.
        """
        listed: list[dict[str, Any]] = await self._context.call(lambda: self._read_maps(tenant))
        return listed

    def watch(self, tenant: str, map_name: str, *, may_start: bool = True) -> None:
        """Let *on_update* be called with each update of a map from now on.

        After each new connection to the map server, the newest update of each key comes first.  A further
        call for the same map only replaces *may_start*.

        Args:
            tenant: Tenant of the map.
            map_name: Name of the map.
            may_start: Whether a map server is started for the updates if the map has none.

        Raises:
            BadRequest: *map_name* is not valid, or the object store is not shared between servers.
        """
        self._connection(tenant, map_name).set_watched(True, may_start=may_start)
        self._update_spare()

    def unwatch(self, tenant: str, map_name: str) -> None:
        """Receive no more updates of a live map; does nothing if this worker does not use the map."""
        connection = self._connections.get((tenant, map_name))
        if connection is not None:
            connection.set_watched(False)
            self._update_spare()

    def give_up(self) -> None:
        """Order the map servers of this worker to release their maps, because the server drains.

        From now on, this worker starts no map server.  Returns before the maps are released.
        """
        self._pool.release_all()

    def cpu_by_tenant(self) -> dict[str, float]:
        """Return the CPU seconds of the map servers that this worker has started, by tenant."""
        return self._pool.cpu_by_tenant()

    @property
    def processes(self) -> list[MapServerProcess]:
        """Map-server processes of this worker that claim or serve a map."""
        return self._pool.in_use

    async def close(self) -> None:
        """Release the maps of this worker's processes (waiting at most 5 s), and close all connections."""
        self.give_up()
        exits = [process.exited for process in self._pool.in_use]
        if exits:
            await asyncio.wait(exits, timeout=_RELEASE_TIMEOUT_S)
        for connection in list(self._connections.values()):
            await connection.close()
        self._threads.shutdown(wait=False)

    def _connection(self, tenant: str, map_name: str) -> MapConnection:
        """Return the connection of a map, which is started if there is none.

        Raises:
            BadRequest: *map_name* is not valid, or the object store is not shared between servers.
        """
        if self._settings.data.store == "memory:":
            raise BadRequest(
                "live maps need an object store that all servers share, but data.store is memory:",
                hint="set data.store to dir:PATH or s3:BUCKET",
            )
        connection = self._connections.get((tenant, map_name))
        if connection is None:
            connection = self._connections[tenant, map_name] = MapConnection(
                self._context,
                tenant,
                map_name,
                on_update=lambda payload: self._on_update(tenant, map_name, payload),
                on_end=self._remove,
            ).start()
        return connection

    def _update_spare(self) -> None:
        """Let the pool keep a spare process if a map has requests or subscribers that may start a map server.

        Otherwise the spare is killed.
        """
        is_used = any(connection.may_need_process for connection in self._connections.values())
        self._pool.set_used(is_used=is_used)

    def _remove(self, connection: MapConnection) -> None:
        self._connections.pop((connection.tenant, connection.map_name), None)
        self._update_spare()

    def _read_maps(self, tenant: str) -> list[dict[str, Any]]:
        """Return the fields of ``live-list`` for each map of *tenant* that has a lease; blocks."""
        maps = []
        for name in self._store.folders(tenant_folder(tenant)):
            record = Lease(self._store, lease_name(tenant, name), decode_lease, self._context.clock).read()
            if record is not None:
                maps.append(
                    {
                        "name": name,
                        "state": _LISTED_STATES[record.state],
                        "owner": record.owner,
                        "server": record.server,
                    }
                )
        return maps
