"""The feed of live maps: it subscribes to ``live/MAP`` as a robot does, while a page shows live maps.

The feed issues its own token with the platform's key; the token allows to read live maps and nothing else.
"""

from __future__ import annotations

import asyncio
import contextlib
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

__all__ = ["LIVE", "SCOPES", "LiveFeed", "histories", "plain"]

# Beginning of the topics of live maps; the name of the map follows.
LIVE = "live/"
# Name of the robot in the feed's token.
_ROBOT = "fleet-page"
SCOPES = ("maps:live", SYNTHETIC)
"""Scopes of the feed's token; the second one lets servers not count the connection as a robot."""
# Validity of the feed's token, in seconds.
_TOKEN_LIFETIME_S = 600.0
# Time between two checks which maps the open pages show, in seconds.
_CHECK_PAGES_S = 0.5
# Time between two readings of the list of live maps, in seconds.
_LIST_EVERY_S = 3.0
# Largest number of live maps of a tenant that are listed.
_MAX_MAPS = 8
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
        """Connect to the platform while a page is open, and follow the maps on it, until cancelled."""
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
        async for key, value in robot.subscribe(LIVE + split_label(label)[1]):
            self._hub.put(LIVE + label, printable(str(key)), plain(value))


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


def _token(state: PlatformState, settings: PlatformSettings, tenant: str) -> str:
    if not state.key_file:
        raise UsageError("the platform has no key", hint="start it again")
    key = read_key(Path(state.key_file))
    return key.issue(
        _ROBOT, now=time.time(), token_id=secrets.token_hex(8), settings=settings.auth,
        ttl_s=min(_TOKEN_LIFETIME_S, settings.auth.token_ttl_s), scopes=SCOPES, tenant=tenant,
    )  # fmt: skip
