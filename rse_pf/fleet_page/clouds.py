"""Versions of maps for the browser: the cloud and the trajectories, small enough to be sent and drawn.

A map may come from a stranger: `packer` runs in a process with limits.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rse_pf.aws.storage import open_data_store
from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest, NotFound
from rse_pf.limited_process import Handler, LimitedProcesses
from rse_pf.local.servers.backend_servers import local_placement
from rse_pf.local.state import platform_settings
from rse_pf.maps.registry import MapRegistry

__all__ = ["MAX_POINTS", "MapPages", "packer"]

MAX_POINTS = 1_000_000
_MEMORY_BYTES = 2 << 30
_MAX_REPLY_BYTES = 32 << 20
_CPU_S = 30.0
_MAX_LISTED = 200
_TENANT = "default"


class MapPages:
    """The maps of one platform, by name and version."""

    def __init__(self, folder: Path) -> None:
        """Read nothing yet; *folder* is that of the platform's state."""
        self._folder = folder
        self._processes = LimitedProcesses(
            "rse_pf.fleet_page.clouds:packer", memory_bytes=_MEMORY_BYTES, cpu_s=_CPU_S,
            max_reply_bytes=_MAX_REPLY_BYTES,
        )  # fmt: skip

    async def maps(self) -> tuple[str, bytes]:
        """Return the maps that have versions, newest version first, as JSON."""
        return "application/json", json.dumps(await asyncio.to_thread(self._maps)).encode()

    async def cloud(self, query: Mapping[str, str]) -> tuple[str, bytes]:
        """Return what `packer` packs of the version ``version`` of the map ``map``.

        Raises:
            NotFound: There is no such version.
            RsePfError: The map cannot be read within limits.
        """
        return "application/octet-stream", await asyncio.to_thread(self._cloud, query)

    def close(self) -> None:
        """End the processes."""
        self._processes.close()

    def _registry(self) -> MapRegistry:
        settings = platform_settings(self._folder) or PlatformSettings()
        store = local_placement(settings, self._folder).store
        return MapRegistry(open_data_store(settings.replace(data={"store": store})), _TENANT)

    def _maps(self) -> list[dict[str, Any]]:
        registry = self._registry()
        return [
            {
                "map": name,
                "versions": [
                    {"id": record.id, "number": record.number, "points": record.points}
                    for record in reversed(registry.versions(name)[-_MAX_LISTED:])
                ],
            }
            for name in registry.names()[:_MAX_LISTED]
        ]

    def _cloud(self, query: Mapping[str, str]) -> bytes:
        registry = self._registry()
        name = query.get("map", "")
        if name not in registry.names():
            raise NotFound("there is no such map", hint="see rse-pf map list")
        return self._processes.call(registry.data(name, query.get("version") or "head"), _CPU_S)


def packer(configuration: str) -> Handler:
    """Return what packs an encoded map: a length, JSON, positions as ``<u2``, colours as bytes.

    The JSON holds ``points`` and ``robots`` (name to the positions of its keyframes, metres); a position is
    ``low + number * step``, by axis.
    """
    import numpy as np

    from rse_pf.maps.format import decode_map
    from rse_pf.terminal import printable

    def pack(data: bytes) -> bytes:
        version = decode_map(data, _MEMORY_BYTES // 2)
        every = max(1, -(-len(version.points) // MAX_POINTS))
        points = np.asarray(version.points, dtype=np.float64)[::every]
        colours = np.asarray(version.colours, dtype=np.uint8)[::every]
        whole = np.asarray(np.isfinite(points).all(axis=1))
        points = points[whole]
        colours = colours[whole] if len(colours) == len(whole) else np.full((len(points), 3), 150, np.uint8)
        low = points.min(axis=0) if len(points) else np.zeros(3)
        step = (np.maximum(points.max(axis=0) - low, 1e-6) if len(points) else np.ones(3)) / 65535
        robots: dict[str, list[list[float]]] = {}
        for keyframe in sorted(version.keyframes, key=lambda each: each.timestamp_s):
            place = [round(float(value), 4) for value in keyframe.T_world_camera[:3, 3]]
            robots.setdefault(printable(keyframe.robot), []).append(place)
        down = np.array([each.T_world_camera[:3, 1] for each in version.keyframes]).reshape(-1, 3)
        told = {
            "points": len(points), "all_points": len(version.points), "low": low.tolist(),
            "step": step.tolist(), "robots": robots,
            "up": (-down.mean(axis=0)).tolist() if len(down) else [0.0, -1.0, 0.0],
        }  # fmt: skip
        head = json.dumps(told).encode()
        head += b" " * (-(4 + len(head)) % 4)
        if not np.isfinite(low).all():
            raise BadRequest("the cloud of this map has no bounds", hint="publish it again")
        numbers = np.round((points - low) / step).astype("<u2") if len(points) else np.empty((0, 3), "<u2")
        return len(head).to_bytes(4, "little") + head + numbers.tobytes() + colours.tobytes()

    return pack
