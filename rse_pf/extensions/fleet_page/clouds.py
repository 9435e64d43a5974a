"""The clouds and trajectories of stored map versions, packed into a compact form for browsers.

A map may be uploaded by an untrusted robot, so that `packer` runs in a process with limited memory and CPU
time.
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
"""Largest number of points of a cloud that are sent; of a larger cloud, an even sample is sent, see
`spread_order`."""
BLOCK_POINTS = 50_000
"""Number of points in a block.

The first block is a sample of the whole cloud, which a browser draws at once.
"""
# Largest number of bytes of packed clouds that are cached: three clouds with a million points.
_CACHE_BYTES = 32 << 20
# Memory limit of the process that packs clouds, in bytes.
_MEMORY_BYTES = 2 << 30
# Largest packed cloud, in bytes.
_MAX_REPLY_BYTES = 32 << 20
# Limit of the CPU time and of the wait for one cloud, in seconds.
_MAX_CPU_S = 30.0
# Largest number of maps of a tenant, and of versions of a map, that are listed.
_MAX_LISTED = 200


class MapPages:
    """The stored maps of one platform as documents for the page: their list, and packed clouds."""

    def __init__(self, folder: Path) -> None:
        """Prepare to read the maps of the platform whose state is in *folder*; nothing is read yet."""
        self._folder = folder
        self._processes = LimitedProcesses(
            "rse_pf.extensions.fleet_page.clouds:packer",
            ProcessLimits(memory_bytes=_MEMORY_BYTES, cpu_s=_MAX_CPU_S, max_reply_bytes=_MAX_REPLY_BYTES),
        )  # fmt: skip
        self._ready: OrderedDict[tuple[str, str], bytes] = OrderedDict()
        self._packing = threading.Lock()
        self._preparing: asyncio.Task[None] | None = None

    async def maps(self) -> tuple[str, bytes]:
        """Return media type and JSON with the maps of all tenants, each with its versions, the newest first.

        At most 200 maps of a tenant and the newest 200 versions of a map are listed; damaged maps are left
        out.  A task is started that packs the cloud of the head of the first map, which the page shows first,
        see `packer`.
        """
        listed = await asyncio.to_thread(self._maps)
        if listed and (self._preparing is None or self._preparing.done()):
            self._preparing = asyncio.create_task(self._prepare({"map": listed[0]["map"]}))
        return "application/json", json.dumps(listed).encode()

    async def cloud(self, query: Mapping[str, str]) -> tuple[str, bytes]:
        """Return media type and packed cloud of the map ``map`` of *query*, of ``version`` or else its head.

        Raises:
            NotFound: There is no such map or version.
            RsePfError: The map is damaged, or exceeds the limits of memory and time.
        """
        return "application/octet-stream", await asyncio.to_thread(self._cloud, query)

    async def _prepare(self, query: Mapping[str, str]) -> None:
        with suppress(RsePfError, OSError):  # the page receives the error when it requests this cloud
            await asyncio.to_thread(self._cloud, query)

    def close(self) -> None:
        """Stop the process that packs clouds."""
        self._processes.close()

    def _maps(self) -> list[dict[str, Any]]:
        store = platform_store(self._folder)
        maps = []
        for tenant in tenants_with(store, "maps"):
            registry = MapRegistry(store, tenant)
            for name in registry.names()[:_MAX_LISTED]:
                with suppress(RsePfError):  # a damaged map is left out; the other ones are listed
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
                packed = self._processes.call(registry.data(name, version), _MAX_CPU_S)
                self._ready[key] = packed
            self._ready.move_to_end(key)
            while len(self._ready) > 1 and sum(map(len, self._ready.values())) > _CACHE_BYTES:
                self._ready.popitem(last=False)
        return packed


def spread_order(count: int) -> npt.NDArray[np.int64]:
    """Return the rows 0 to *count* - 1 in an order of which every prefix is an even sample of all rows.

    The stride is near the golden ratio times *count*.  Rows that follow each other in a cloud are mostly near
    each other in space, so that a prefix is also spread over space.
    """
    import numpy as np

    rows = max(1, count)
    while math.gcd(stride := round(rows * 0.6180339887498949), rows) > 1:
        rows += 1
    order = np.arange(rows, dtype=np.int64) * stride % rows
    return order[order < count]


def packer(configuration: str) -> Handler:
    """Return the function that packs an encoded map for browsers; it runs in a process with limits.

    A packed map is the length of a JSON header (4 bytes, little-endian), the header, and blocks of points.
    The header holds the number of points ``points`` and that of a block ``block``, the positions (m) of the
    keyframes of each robot in ``robots``, and in ``fit`` two corners of a box that contains nearly all points
    (empty without points).  A block has the positions of its points as ``<u2``, then their colours as bytes
    (RGB); the position on each axis is ``low + number * step``.  Points are in `spread_order`.
    *configuration* is not used.
    """
    import numpy as np

    from rse_pf.maps.format import decode_map
    from rse_pf.terminal import printable

    def pack(data: bytes) -> bytes:
        version = decode_map(data, _MEMORY_BYTES // 2)
        order = spread_order(len(version.points))[:MAX_POINTS]
        # Copied, since the array of the map may be unaligned in memory, which makes take() slow.
        points = version.points.copy().take(order, axis=0)
        colours = version.colours.take(order, axis=0)
        low = np.array([points[:, axis].min() if len(points) else 0.0 for axis in range(3)], np.float32)
        high = np.array([points[:, axis].max() if len(points) else 0.0 for axis in range(3)], np.float32)
        step = np.maximum(high.astype(np.float64) - low, 1e-6) / 65535
        robots: dict[str, list[list[float]]] = {}
        for keyframe in sorted(version.keyframes, key=lambda row: row.timestamp_s):
            place = [round(float(value), 4) for value in keyframe.T_world_camera[:3, 3]]
            robots.setdefault(printable(keyframe.robot), []).append(place)
        down = np.array([keyframe.T_world_camera[:3, 1] for keyframe in version.keyframes]).reshape(-1, 3)
        # Percentiles, so that a few distant points, such as those of a mirror, do not extend the box.
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
