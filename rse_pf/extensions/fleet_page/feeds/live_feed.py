"""The feed of live maps: it subscribes to ``live/MAP`` as a robot does, while a page shows live maps.

The feed issues its own token with the platform's key; the token allows to read live maps and nothing else.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import secrets
import time
from collections.abc import Awaitable, Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rse_pf.auth.roster import SYNTHETIC
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError, UsageError
from rse_pf.extensions.fleet_page.hub import Hub
from rse_pf.extensions.fleet_page.tenant_maps import map_label, platform_store, split_label, tenants_with
from rse_pf.local.firewall import read_key
from rse_pf.local.state import PlatformState, platform_settings, read_state
from rse_pf.terminal import printable

__all__ = ["LIVE", "SCOPES", "LiveFeed", "RobotPaths", "histories", "plain"]

LIVE = "live/"
# Name of the robot in the feed's token.
_ROBOT = "fleet-page"
SCOPES = ("maps:live", SYNTHETIC)
"""Scopes of the feed's token; the second one lets servers not count the connection as a robot."""
# Validity of the feed's token, in seconds.
_TTL_S = 600.0
# Time between two checks which maps the open pages show, in seconds.
_CHECK_PAGES_S = 0.5
# Time between two readings of the list of live maps, in seconds.
_LIST_EVERY_S = 3.0
# Largest number of live maps of a tenant that are listed.
_MAX_MAPS = 8
# Largest number of positions in the path of a robot; above it, the oldest are dropped.
_MAX_PATH = 2000
# Time between two readings of the paths of a live map, in seconds.
_HISTORY_EVERY_S = 3.0


class LiveFeed:
    """Puts the live maps that open pages show into a `Hub`."""

    def __init__(self, hub: Hub, folder: Path) -> None:
        """Prepare the feed to *hub* of the platform whose state is in *folder*; `run` connects to it."""
        self._hub = hub
        self._folder = folder
        self._followed: dict[str, asyncio.Task[None]] = {}

    async def run(self) -> None:
        """Connect to the platform while a page is open, and follow the maps it shows, until cancelled."""
        while True:
            if self._hub.watches("maps"):
                with contextlib.suppress(RsePfError, OSError):
                    await self._connect()
            await asyncio.sleep(_CHECK_PAGES_S)

    async def _connect(self) -> None:
        from client_sdk import connect

        state = await asyncio.to_thread(read_state, self._folder)
        if state is None or not state.url or state.lan:
            return  # its certificate has a private authority that the feed does not know: docs/fleet_page.md
        settings = platform_settings(self._folder) or PlatformSettings()
        tenants = await asyncio.to_thread(self._tenants)

        def token_of(tenant: str) -> Callable[[], Awaitable[str]]:
            async def token() -> str:
                return _token(state, settings, tenant)

            return token

        try:
            async with contextlib.AsyncExitStack() as connected:
                robots = {
                    tenant: await connected.enter_async_context(
                        connect(state.url, token=token_of(tenant), codec="json")
                    )
                    for tenant in tenants
                }
                while self._hub.watches("maps") and await asyncio.to_thread(self._tenants) == tenants:
                    await self._follow_if_asked(robots)
        finally:
            for task in self._followed.values():
                task.cancel()
            self._followed.clear()

    def _tenants(self) -> list[str]:
        return tenants_with(platform_store(self._folder), "live")

    async def _follow_if_asked(self, robots: Mapping[str, Any]) -> None:
        """List the live maps through the connection of each tenant, and follow those that a page shows."""
        labels: dict[str, Any] = {}
        for tenant, robot in robots.items():
            with contextlib.suppress(RsePfError):  # an error for one tenant does not affect the others
                listed = (await robot.call("live-list", {})).reply.get("maps", [])
                labels.update({map_label(tenant, str(entry["name"])): robot for entry in listed[:_MAX_MAPS]})
        self._hub.put("maps", "live", list(labels))
        for _ in range(round(_LIST_EVERY_S / _CHECK_PAGES_S)):
            for label, robot in labels.items():
                if label not in self._followed and self._hub.watches(LIVE + label):
                    self._followed[label] = asyncio.ensure_future(self._follow(robot, label))
            await asyncio.sleep(_CHECK_PAGES_S)

    async def _follow(self, robot: Any, label: str) -> None:
        reading = asyncio.ensure_future(self._follow_history(robot, label))
        try:
            await self._follow_updates(robot, label)
        finally:
            reading.cancel()

    async def _follow_history(self, robot: Any, label: str) -> None:
        """Publish the paths of all robots from the map's keyframes, also from before a page was open."""
        version = -1
        while True:
            if self._hub.watches(LIVE + label):
                with contextlib.suppress(RsePfError):
                    request = {"map": split_label(label)[1], "paths": True}
                    shown = (await robot.call("live-show", request, keep=True)).reply
                    if shown.get("version") != version:
                        version = shown.get("version")
                        for key, value in histories(shown.get("paths", ())).items():
                            self._hub.put(LIVE + label, f"history/{key}", value)
            await asyncio.sleep(_HISTORY_EVERY_S)

    async def _follow_updates(self, robot: Any, label: str) -> None:
        paths = RobotPaths()
        async for key, value in robot.subscribe(LIVE + split_label(label)[1]):
            message = plain(value)
            self._hub.put(LIVE + label, printable(str(key)), message)
            path = paths.take(message)
            if path is not None:
                self._hub.put(LIVE + label, f"path/{message['robot']}", path)


class RobotPaths:
    """The path of each robot of a live map in its odometry frame, which corrections of the map move.

    Positions are in metres.  The path of a robot without metric scale is rescaled when the map finds another
    scale.
    """

    def __init__(self) -> None:
        """Start without robots."""
        self._T_map_odom: dict[str, tuple[Any, Any]] = {}
        self._scales: dict[str, tuple[Any, float]] = {}
        self._paths: dict[str, dict[str, Any]] = {}

    def take(self, value: Mapping[str, Any]) -> dict[str, Any] | None:
        """Process *value*, an alignment or pose of a robot; return the robot's path if a position was added.

        None for all other values, and for a pose before the alignment of its segment.
        """
        robot, segment = str(value.get("robot", "")), value.get("segment")
        T_map_odom, T_map_camera = value.get("T_map_odom"), value.get("T_map_camera")
        if value.get("kind") == "alignment" and value.get("aligned") and _is_matrix(T_map_odom):
            self._T_map_odom[robot] = (segment, T_map_odom)
            self._stretch(robot, segment, value.get("scale"))
        known = self._T_map_odom.get(robot)
        if (
            value.get("kind") != "pose"
            or known is None
            or known[0] != segment
            or not _is_matrix(T_map_camera)
        ):
            return None
        assert isinstance(T_map_camera, list)
        path = self._paths.get(robot)
        if path is None or path["segment"] != segment:
            path = self._paths[robot] = {"segment": segment, "points": []}
        path["points"] = [*path["points"], _position_in_odometry(known[1], T_map_camera)][-_MAX_PATH:]
        return path

    def _stretch(self, robot: str, segment: Any, scale: Any) -> None:
        """Store *scale*, the metres per unit of a robot's segment, and rescale the path by its change.

        A value that is no positive number is ignored.
        """
        if not isinstance(scale, float) or not 0.0 < scale < math.inf:
            return
        before, path = self._scales.get(robot), self._paths.get(robot)
        self._scales[robot] = segment, scale
        if before is not None and path is not None and before[0] == segment == path["segment"]:
            stretch = scale / before[1]
            path["points"] = [[stretch * each for each in point] for point in path["points"]]


def histories(paths: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return for each robot of *paths* its positions (m, in the map) as ``parts``, a list for each segment.

    All texts are escaped.
    """
    found: dict[str, dict[str, Any]] = {}
    for path in paths:
        robot = printable(str(path.get("robot", "")))
        history = found.setdefault(robot, {"kind": "history", "robot": robot, "parts": []})
        history["parts"].append(plain(path.get("points", [])))
    return found


def plain(value: Any) -> Any:
    """Return *value* for JSON: arrays as lists, and all texts escaped, also inside mappings and lists."""
    if isinstance(value, Mapping):
        return {printable(str(name)): plain(item) for name, item in value.items()}
    if isinstance(value, str):
        return printable(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value


def _is_matrix(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 16


def _position_in_odometry(T_map_odom: Sequence[float], T_map_camera: Sequence[float]) -> list[float]:
    """Return the position ``(3,)`` (m) of the camera in the odometry frame; both poses are 16 numbers."""
    moved = [T_map_camera[4 * row + 3] - T_map_odom[4 * row + 3] for row in range(3)]
    return [
        round(sum(T_map_odom[4 * row + column] * moved[row] for row in range(3)), 4) for column in range(3)
    ]


def _token(state: PlatformState, settings: PlatformSettings, tenant: str) -> str:
    if not state.key_file:
        raise UsageError("the platform has no key", hint="start it again")
    key = read_key(Path(state.key_file))
    return key.issue(
        _ROBOT, now=time.time(), token_id=secrets.token_hex(8), settings=settings.auth,
        ttl_s=min(_TTL_S, settings.auth.token_ttl_s), scopes=SCOPES, tenant=tenant,
    )  # fmt: skip
