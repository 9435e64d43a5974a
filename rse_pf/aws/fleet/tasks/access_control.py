"""Fetch deny list and roster of the robots, every half second: a disabled robot is cut off within two."""

from __future__ import annotations

from rse_pf.auth.roster import DenyList, Roster, from_json
from rse_pf.auth.trust_store import DENY_NAME, REFRESH_S, ROBOTS_NAME
from rse_pf.aws.fleet.task import AgentContext, Task
from rse_pf.aws.fleet.tasks.fetch import fetch

__all__ = ["task"]


def task(context: AgentContext) -> Task:
    """Write deny list and roster if they changed; a missing or invalid one changes nothing."""

    def fetch_access_control() -> None:
        folder = context.config.keys_file.parent
        # The deny list comes first, so that a roster that cannot be read keeps no revocation from the server.
        fetch(context, DENY_NAME, folder / DENY_NAME, lambda data: from_json(data, DenyList))
        fetch(context, ROBOTS_NAME, folder / ROBOTS_NAME, lambda data: from_json(data, Roster))

    return Task(name="access-control", period_s=REFRESH_S, call=fetch_access_control, in_thread=True)
