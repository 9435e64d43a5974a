"""Fetch the deny list and the roster every half second: a revoked robot is disconnected within 2 s."""

from __future__ import annotations

from rse_pf.auth.roster import DenyList, Roster, from_json
from rse_pf.auth.trust_store import DENY_NAME, REFRESH_S, ROBOTS_NAME
from rse_pf.aws.fleet.task import AgentContext, Task
from rse_pf.aws.fleet.tasks.fetch import fetch

__all__ = ["task"]


def task(context: AgentContext) -> Task:
    """Return the task that writes deny list and roster to files of the server if they changed in the bucket.

    The file of a missing or invalid object stays as it is.
    """

    def fetch_access_control() -> None:
        folder = context.config.keys_file.parent
        # The deny list comes first: a roster that cannot be read must not delay a revocation.
        fetch(context, DENY_NAME, folder / DENY_NAME, lambda data: from_json(data, DenyList))
        fetch(context, ROBOTS_NAME, folder / ROBOTS_NAME, lambda data: from_json(data, Roster))

    return Task(name="access-control", period_s=REFRESH_S, call=fetch_access_control, in_thread=True)
