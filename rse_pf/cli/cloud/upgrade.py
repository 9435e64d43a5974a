"""rse-pf cloud upgrade: replace the servers by those of the newest deployment, or return to the old ones."""

from __future__ import annotations

import time
from datetime import datetime, timezone

from rse_pf.command_line.options import Action, NoOptions
from rse_pf.config import PlatformSettings
from rse_pf.terminal import show

__all__ = ["ACTION"]


def upgrade_servers(request: NoOptions, settings: PlatformSettings) -> int:
    """Replace the servers by those of the newest deployment, and print the progress until the end.

    Returns 0 if all servers run the new version; 1 if the old servers came back, it failed, or on Ctrl-C,
    after which AWS continues.
    """
    from rse_pf.aws.account import open_account
    from rse_pf.aws.fleet.upgrade import upgrade

    try:
        ended = upgrade(
            open_account(settings.cloud.region), settings, report_progress=lambda line: show(f"  {line}"),
            sleep=time.sleep, now=lambda: datetime.now(timezone.utc),
        )  # fmt: skip
    except KeyboardInterrupt:
        show("", "AWS continues without this command; run it again to follow")
        return 1
    if ended.reason:
        show(
            f"not upgraded to version {ended.version}: {ended.reason}",
            *(f"  | {line}" for line in ended.console),
        )
        return 1
    show(f"all servers run version {ended.version}" + ("" if ended.replaced else ", as before"))
    return 0


ACTION = Action(
    help="replace the servers by those of the newest deployment, one by one, or return to the old ones",
    request=NoOptions,
    run=upgrade_servers,
)
