"""Find where photos were taken in maps, in processes that have limits and may be killed.

A process reads maps itself and keeps the last ones, so that the data server never holds a map nor decodes an
image.
"""

from __future__ import annotations

import contextlib
import json
from collections import Counter, OrderedDict
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgspec

from rse_pf.config import PlatformSettings
from rse_pf.data_server.robot_processes import RobotProcesses, max_map_bytes, shared_store
from rse_pf.errors import MissingExtra
from rse_pf.identity import RobotId
from rse_pf.maps.photos import MapOutline, PhotoLens, PhotoLocation
from rse_pf.maps.registry import MapRegistry
from rse_pf.processes.limited import Handler, limit_cpu

if TYPE_CHECKING:
    from rse_pf.maps.format import MapVersion
    from rse_pf.services.mapping.place import MapIndex

__all__ = ["PROCESSES", "TARGET", "PhotoLocaliser", "make_handler"]

TARGET = f"{__name__}:make_handler"
PROCESSES = 3  # a robot has at most one, and the last is left to a tenant that has none (`FairThreads`)
_CACHED_MAPS = 4  # maps that a process keeps in memory
_MAX_PHOTO_S = 3.0  # CPU time of a photo, without that of reading the map: 16 megapixels take 0.7 s


class _Request(msgspec.Struct, frozen=True, kw_only=True):
    """A *photo* to localise in a map, or None for the outline of the map.

    *version* and *data* are those of the map where the process cannot read the store itself.
    """

    tenant: str
    name: str
    photo: bytes | None = None
    lens: PhotoLens | None = None
    version: str = ""
    data: bytes = b""


class PhotoLocaliser:
    """Localises photos in *processes*, which have the target `TARGET`."""

    def __init__(self, processes: RobotProcesses) -> None:
        self.count = processes.count
        self._processes = processes

    def localise(
        self, robot: RobotId, name: str, photo: bytes, lens: PhotoLens, charge: Callable[[float], None]
    ) -> PhotoLocation:
        """Return where *photo*, which *robot* sent, was taken in the head of the map *name*; blocks.

        *charge* gets the CPU seconds that it took, also if it fails.

        Raises:
            NotFound: The robot's tenant has no such map.
            BadRequest, LimitExceeded, InvalidCamera: As `localise_photo` says.
            MissingExtra: The server lacks what localises.
            Crashed, Busy, Expired, WorkerLost: As `RobotProcesses.call` says.
        """
        reply = self._call(robot, _Request(tenant=robot.tenant, name=name, photo=photo, lens=lens), charge)
        return msgspec.msgpack.decode(reply, type=PhotoLocation)

    def outline(self, robot: RobotId, name: str, charge: Callable[[float], None]) -> MapOutline:
        """Return the head of the map *name* as it is seen from above; blocks, and raises as `localise`."""
        reply = self._call(robot, _Request(tenant=robot.tenant, name=name), charge)
        return msgspec.msgpack.decode(reply, type=MapOutline)

    def close(self) -> None:
        """End the processes; a call that is under way raises WorkerLost."""
        self._processes.close()

    def _call(self, robot: RobotId, request: _Request, charge: Callable[[float], None]) -> bytes:
        store = self._processes.private_store
        if store is not None:
            maps = MapRegistry(store, robot.tenant)
            version = maps.head(request.name).id
            request = msgspec.structs.replace(request, version=version, data=maps.data(request.name, version))
        near = f"{request.tenant}/{request.name}"
        return self._processes.call(robot, msgspec.msgpack.encode(request), near=near, charge=charge)


def make_handler(configuration: str) -> Handler:
    """Import what localises and return what answers in the process; *configuration* has the settings."""
    from rse_pf.images import load_opencv
    from rse_pf.services.mapping.photo import localise_photo, location_of, outline_of

    settings = PlatformSettings.from_dict(json.loads(configuration))
    with contextlib.suppress(MissingExtra):  # the answer to each request says so
        load_opencv()
    maps = _Maps(settings)

    def answer(data: bytes) -> bytes:
        request = msgspec.msgpack.decode(data, type=_Request)
        version, map_version, index = maps.find(request)
        reply: Any
        if request.photo is None or request.lens is None:
            reply = outline_of(map_version, version)
        else:
            limit_cpu(_MAX_PHOTO_S)
            reply = location_of(localise_photo(request.photo, request.lens, index), version)
        return msgspec.msgpack.encode(reply)

    return answer


class _Maps:
    """The maps that a process has read last, of as many tenants as there are."""

    def __init__(self, settings: PlatformSettings) -> None:
        self._store = shared_store(settings)
        self._max_bytes = max_map_bytes(settings)
        self._known: OrderedDict[tuple[str, str, str], tuple[MapVersion, MapIndex]] = OrderedDict()

    def find(self, request: _Request) -> tuple[str, MapVersion, MapIndex]:
        """Return the version, the map and its index that *request* names.

        Raises:
            NotFound: There is no such map of this tenant.
            LimitExceeded: It holds no keyframe, or more than are computed with.
        """
        from rse_pf.services.mapping.place import index_map

        maps, version = None, request.version
        if self._store is not None:
            maps = MapRegistry(self._store, request.tenant, max_bytes=self._max_bytes)
            version = maps.head(request.name).id
        key = (request.tenant, request.name, version)
        found = self._known.pop(key, None)
        if found is None:
            data = request.data if maps is None else maps.data(request.name, version)
            if len(self._known) == _CACHED_MAPS:
                del self._known[self._superfluous()]
            found = index_map(data)
        self._known[key] = found
        return version, *found

    def _superfluous(self) -> tuple[str, str, str]:
        """Return the map that was used least recently of the tenant that has most."""
        counts = Counter(tenant for tenant, _, _ in self._known)
        return max(self._known, key=lambda key: counts[key[0]])  # the first of equals is the oldest
