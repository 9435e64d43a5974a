"""The page of a local platform: its feeds, documents and operations."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rse_pf.errors import NotFound
from rse_pf.extensions.fleet_page.app import PageActions
from rse_pf.extensions.fleet_page.clouds import MapPages
from rse_pf.extensions.fleet_page.feeds.live_feed import LiveFeed
from rse_pf.extensions.fleet_page.feeds.platform_feed import LocalFeed
from rse_pf.extensions.fleet_page.hub import Hub
from rse_pf.extensions.fleet_page.operations import LocalOperations
from rse_pf.extensions.fleet_page.replays import Replays
from rse_pf.extensions.fleet_page.server import listen, serve_page
from rse_pf.terminal import show_json

__all__ = ["serve_local_page"]


def serve_local_page(folder: Path, *, port: int) -> int:
    """Serve the page of the platform whose state is in *folder*, until a signal; return the exit code.

    The page's address is printed as JSON; *port* on loopback is replaced by a free one if it is 0 or taken.
    """
    hub = Hub()
    feed, live = LocalFeed(hub, folder), LiveFeed(hub, folder)
    maps, replays = MapPages(folder), Replays(folder)

    async def page(name: str, query: Mapping[str, str]) -> tuple[str, bytes]:
        if name == "maps":
            return await maps.maps()
        if name == "cloud":
            return await maps.cloud(query)
        if name == "replay":
            return await replays.page(query)
        raise NotFound(f"there is no page {name[:40]!r}", hint="open /")

    try:
        return serve_page(
            hub,
            PageActions(operate=LocalOperations(folder).operate, page=page),
            listening=listen(port),
            works=lambda: [feed.run(), live.run()],
            platform=folder,
            ready=lambda url: show_json({"url": url}),
        )
    finally:
        maps.close()
        replays.close()
