"""Versions of maps for the browser: the cloud and the trajectories, small enough to be sent and drawn.

A map may come from a stranger: `packer` runs in a process with limits.
"""

from __future__ import annotations

import asyncio
import json
import math
import threading
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rse_pf.errors import NotFound, RsePfError
from rse_pf.extensions.fleet_page.tenant_maps import map_label, platform_store, split_label, tenants_with
from rse_pf.maps.registry import MapRegistry
from rse_pf.processes.limited import Handler, LimitedProcesses, ProcessLimits

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

__all__ = ["BLOCK_POINTS", "MAX_POINTS", "MapPages", "packer", "spread_order"]

MAX_POINTS = 1_000_000
BLOCK_POINTS = 50_000
"""Points of a block; the first one is a sample of the whole cloud, which a browser draws at once."""
_KEPT_BYTES = 32 << 20
"""Of clouds that are ready: three of a million points."""
_MEMORY_BYTES = 2 << 30
_MAX_REPLY_BYTES = 32 << 20
_CPU_S = 30.0
_MAX_LISTED = 200


class MapPages:
    """The maps of one platform, by name and version."""

    def __init__(self, folder: Path) -> None:
        """Read nothing yet; *folder* is that of the platform's state."""
        self._folder = folder
        self._processes = LimitedProcesses(
            "rse_pf.extensions.fleet_page.clouds:packer",
            ProcessLimits(memory_bytes=_MEMORY_BYTES, cpu_s=_CPU_S, max_reply_bytes=_MAX_REPLY_BYTES),
        )  # fmt: skip
        self._ready: OrderedDict[tuple[str, str], bytes] = OrderedDict()
        self._packing = threading.Lock()
        self._preparing: asyncio.Task[None] | None = None

    async def maps(self) -> tuple[str, bytes]:
        """Return the maps that have versions, newest version first, as JSON.

        The cloud that the page shows first, the newest one of the first map, is packed meanwhile.
        """
        listed = await asyncio.to_thread(self._maps)
        if listed and (self._preparing is None or self._preparing.done()):
            self._preparing = asyncio.create_task(self._prepare({"map": listed[0]["map"]}))
        return "application/json", json.dumps(listed).encode()

    async def cloud(self, query: Mapping[str, str]) -> tuple[str, bytes]:
        """Return what `packer` packs of the version ``version`` of the map ``map``.

        Raises:
            NotFound: There is no such version.
            RsePfError: The map cannot be read within limits.
        """
        return "application/octet-stream", await asyncio.to_thread(self._cloud, query)

    async def _prepare(self, query: Mapping[str, str]) -> None:
        with suppress(RsePfError, OSError):  # the page is told when it asks for this cloud
            await asyncio.to_thread(self._cloud, query)

    def close(self) -> None:
        """End the processes."""
        self._processes.close()

    def _maps(self) -> list[dict[str, Any]]:
        store = platform_store(self._folder)
        maps = []
        for tenant in tenants_with(store, "maps"):
            registry = MapRegistry(store, tenant)
            for name in registry.names()[:_MAX_LISTED]:
                with suppress(RsePfError):  # a damaged map hides no other one
                    versions = [
                        {"id": record.id, "number": record.number, "points": record.points}
                        for record in reversed(registry.versions(name)[-_MAX_LISTED:])
                    ]
                    maps.append({"map": map_label(tenant, name), "versions": versions})
        return maps

    def _cloud(self, query: Mapping[str, str]) -> bytes:
        label = query.get("map", "")
        tenant, name = split_label(label)
        registry = MapRegistry(platform_store(self._folder), tenant)
        if name not in registry.names():
            raise NotFound("there is no such map", hint="see rse-pf map list")
        version = registry.record(name, query.get("version") or "head").id
        key = label, version
        with self._packing:
            packed = self._ready.get(key)
            if packed is None:
                packed = self._processes.call(registry.data(name, version), _CPU_S)
                self._ready[key] = packed
            self._ready.move_to_end(key)
            while len(self._ready) > 1 and sum(map(len, self._ready.values())) > _KEPT_BYTES:
                self._ready.popitem(last=False)
        return packed


def spread_order(count: int) -> npt.NDArray[np.int64]:
    """Return the rows below *count* in an order whose beginning, of any length, is a sample of all.

    Steps of the golden ratio leave the most even gaps; neighbours in a cloud mostly are neighbours in space.
    """
    import numpy as np

    rows = max(1, count)
    while math.gcd(stride := round(rows * 0.6180339887498949), rows) > 1:
        rows += 1
    order = np.arange(rows, dtype=np.int64) * stride % rows
    return order[order < count]


def packer(configuration: str) -> Handler:
    """Return what packs an encoded map: a length, JSON, and blocks of points.

    The JSON holds ``points``, ``block``, ``robots`` (name to the positions of its keyframes, metres) and
    ``fit`` (two corners of a box that holds nearly all points, none without points).  A block has ``block``
    points, the last one the rest: positions as ``<u2``, then colours as bytes.  A position is
    ``low + number * step``, by axis.  Points stand in `spread_order`.
    """
    import numpy as np

    from rse_pf.maps.format import decode_map
    from rse_pf.terminal import printable

    def pack(data: bytes) -> bytes:
        version = decode_map(data, _MEMORY_BYTES // 2)
        order = spread_order(len(version.points))[:MAX_POINTS]
        points = version.points.copy().take(order, axis=0)  # the map's own may lie at any address: slow
        colours = version.colours.take(order, axis=0)
        low = np.array([points[:, axis].min() if len(points) else 0.0 for axis in range(3)], np.float32)
        high = np.array([points[:, axis].max() if len(points) else 0.0 for axis in range(3)], np.float32)
        step = np.maximum(high.astype(np.float64) - low, 1e-6) / 65535
        robots: dict[str, list[list[float]]] = {}
        for keyframe in sorted(version.keyframes, key=lambda row: row.timestamp_s):
            place = [round(float(value), 4) for value in keyframe.T_world_camera[:3, 3]]
            robots.setdefault(printable(keyframe.robot), []).append(place)
        down = np.array([keyframe.T_world_camera[:3, 1] for keyframe in version.keyframes]).reshape(-1, 3)
        # A few points far away, such as those of a mirror, must not make the rest small.
        shares = np.percentile(points, (1, 99), axis=0) if len(points) else np.empty((0, 3))
        header = {
            "fit": shares.round(4).tolist(),
            "points": len(points), "all_points": len(version.points), "block": BLOCK_POINTS,
            "low": low.tolist(), "step": step.tolist(), "robots": robots,
            "up": (-down.mean(axis=0)).tolist() if len(down) else [0.0, -1.0, 0.0],
        }  # fmt: skip
        head = json.dumps(header).encode()
        head += b" " * (-(4 + len(head)) % 4)
        numbers = ((points - low) * (1 / step).astype(np.float32) + np.float32(0.5)).clip(0, 65535)
        numbers = numbers.astype("<u2")
        parts = [len(head).to_bytes(4, "little"), head]
        for at in range(0, len(points), BLOCK_POINTS):
            block = slice(at, at + BLOCK_POINTS)
            parts += (numbers[block].tobytes(), colours[block].tobytes())
        return b"".join(parts)

    return pack
