"""Find the poses of photos in maps, in processes with limits on memory and CPU time.

A process reads maps from the store itself and caches the last `_CACHED_MAPS`, so that the data server neither
keeps maps nor decodes images.
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

TARGET = f"{__name__}:make_handler"  # function that a new process calls to get its handler
PROCESSES = 3  # a robot uses at most one; the last free one serves only a tenant without one (`FairThreads`)
_CACHED_MAPS = 4  # maps that one process keeps in memory
_MAX_PHOTO_S = 3.0  # CPU time limit of one photo after its map was read; a photo of 16 megapixels takes 0.7 s


class _Request(msgspec.Struct, frozen=True, kw_only=True):
    """A request to a process: localise *photo* in the map *name*, or return the map's outline if it is None.

    *version* and *data*, the bytes of the map, are sent only if the process cannot read the store itself.
    """

    tenant: str
    name: str
    photo: bytes | None = None
    lens: PhotoLens | None = None
    version: str = ""
    data: bytes = b""


class PhotoLocaliser:
    """Localises photos in *processes*, which must have been made with `TARGET`."""

    def __init__(self, processes: RobotProcesses) -> None:
        self.count = processes.count
        self._processes = processes

    def localise(
        self, robot: RobotId, name: str, photo: bytes, lens: PhotoLens, charge: Callable[[float], None]
    ) -> PhotoLocation:
        """Return the pose of *photo* in the head of the map *name*; block until it is computed.

        *charge* is called with the CPU seconds that the photo took, also if localising it fails.

        Raises:
            NotFound: The tenant of *robot* has no such map.
            BadRequest, LimitExceeded, InvalidCamera: See `localise_photo`.
            MissingExtra: OpenCV is not installed on the server.
            Crashed, Busy, Expired, WorkerLost: See `RobotProcesses.call`.
        """
        reply = self._call(robot, _Request(tenant=robot.tenant, name=name, photo=photo, lens=lens), charge)
        return msgspec.msgpack.decode(reply, type=PhotoLocation)

    def outline(self, robot: RobotId, name: str, charge: Callable[[float], None]) -> MapOutline:
        """Return the head of the map *name* as seen from above; block, and raise the errors of `localise`."""
        reply = self._call(robot, _Request(tenant=robot.tenant, name=name), charge)
        return msgspec.msgpack.decode(reply, type=MapOutline)

    def close(self) -> None:
        """Kill the processes; a running call raises WorkerLost."""
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
    """Import OpenCV and the localiser, and return the function that answers requests in the process.

    *configuration* is the platform's settings as JSON.
    """
    from rse_pf.images import load_opencv
    from rse_pf.services.mapping.photo import localise_photo, location_of, outline_of

    settings = PlatformSettings.from_dict(json.loads(configuration))
    with contextlib.suppress(MissingExtra):  # each request is answered with this error instead
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
    """The cache of a process: the maps that it used last, with their indexes, of any tenants."""

    def __init__(self, settings: PlatformSettings) -> None:
        self._store = shared_store(settings)
        self._max_bytes = max_map_bytes(settings)
        self._known: OrderedDict[tuple[str, str, str], tuple[MapVersion, MapIndex]] = OrderedDict()

    def find(self, request: _Request) -> tuple[str, MapVersion, MapIndex]:
        """Return the version id, the map and the index of the map that *request* names, read it if necessary.

        Raises:
            NotFound: The tenant has no such map.
            LimitExceeded: The map has no keyframes, or more keyframes or features than the limits allow.
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
        """Return the key of the map to drop: of the tenant with most cached maps, the least recently used."""
        counts = Counter(tenant for tenant, _, _ in self._known)
        # Of several maps with the greatest count `max` returns the first, which was used least recently.
        return max(self._known, key=lambda key: counts[key[0]])
