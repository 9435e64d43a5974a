"""The page of a platform of this machine: what feeds it, and what it can ask for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from rse_pf.errors import NotFound
from rse_pf.fleet_page.app import PageActions
from rse_pf.fleet_page.hub import Hub
from rse_pf.fleet_page.operations import LocalOperations
from rse_pf.fleet_page.platform_feed import LocalFeed
from rse_pf.fleet_page.server import ANNOUNCEMENT, listen, serve_page
from rse_pf.local.state import control_token_file
from rse_pf.terminal import show_json

__all__ = ["serve_local_page"]


def serve_local_page(folder: Path, *, port: int) -> int:
    """Serve the page of the platform in *folder* until a signal; return the exit code."""
    hub = Hub()
    feed = LocalFeed(hub, folder)

    async def page(name: str, query: Mapping[str, str]) -> tuple[str, bytes]:
        raise NotFound(f"there is no page {name[:40]!r}", hint="open /")

    return serve_page(
        hub,
        PageActions(operate=LocalOperations(folder).operate, page=page),
        listening=listen(port),
        works=lambda: [feed.run()],
        token_file=control_token_file(folder),
        announce=folder / ANNOUNCEMENT,
        ready=lambda url: show_json({"url": url}),
    )
