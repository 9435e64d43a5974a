"""The page of a deployment on AWS, served on the operator's machine.

The page can change nothing in the deployment.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from typing import Any

from rse_pf.aws.account import Account
from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest, NotFound
from rse_pf.extensions.fleet_page.app import PageActions
from rse_pf.extensions.fleet_page.feeds.cloud_feed import CloudFeed
from rse_pf.extensions.fleet_page.feeds.cloud_overview import read_overview
from rse_pf.extensions.fleet_page.hub import Hub
from rse_pf.extensions.fleet_page.server import listen, serve_page

__all__ = ["serve_cloud_page"]


def serve_cloud_page(
    account: Account,
    settings: PlatformSettings,
    *,
    port: int,
    ready: Callable[[str], None],
) -> int:
    """Serve the page of the deployment in *account* until SIGTERM or SIGINT; return the exit code.

    Args:
        account: The operator's AWS account and region.
        settings: Settings of the deployment.
        port: Port on loopback; a free one is used if it is 0 or taken.
        ready: Called with the page's address, which contains a one-time key.

    Raises:
        ConfigurationError: There is no deployment in the region, or AWS rejected the credentials.
        StoreError: AWS does not answer.
        MissingExtra: uvicorn is not installed.
    """
    first = read_overview(account, settings, now=datetime.now(timezone.utc))
    hub = Hub()
    feed = CloudFeed(hub, account, settings, first)
    return serve_page(
        hub,
        PageActions(operate=_operate, page=_page),
        listening=listen(port),
        works=lambda: [feed.run()],
        platform=None,
        ready=ready,
    )


async def _operate(action: str, parameters: Mapping[str, str]) -> Mapping[str, Any]:
    raise BadRequest("this page only shows the deployment", hint="see docs/operations.md")


async def _page(name: str, query: Mapping[str, str]) -> tuple[str, bytes]:
    if name == "maps":
        return "application/json", b"[]"
    raise NotFound("maps and recordings of the deployment are not shown here", hint="see docs/operations.md")
