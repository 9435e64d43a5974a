"""Follow the list of published services: fetch their archives, check them, and have the server load them.

The agent only reads the bucket; operators publish with ``rse-pf service publish``.  If a list or an archive
is invalid, the installed services stay, and the agent waits until the list changes.
"""

from __future__ import annotations

import msgspec

from rse_pf.aws.fleet.task import AgentContext, Task
from rse_pf.errors import ConfigurationError, Disconnected, NotFound
from rse_pf.services.custom.publishing import (
    LIST_NAME,
    LIST_POLL_PERIOD_S,
    PublishedFolder,
    PublishedList,
    PublishedService,
    archive_name,
    damaged_error,
)

__all__ = ["FOLDER", "task"]

FOLDER = "services"
"""Name of the folder of the services in the agent's state folder; rse-pf.service names it, too."""
_EMPTY = msgspec.json.encode(PublishedList())  # stands for a list that was never published


def task(context: AgentContext) -> Task:
    """Return the task that installs the listed services when the list changes; the server then loads them."""
    folder = PublishedFolder(context.config.state_folder / FOLDER)
    refused, loaded = b"", b""

    def fetch(entry: PublishedService) -> bytes:
        name = archive_name(entry.archive)
        size = context.artifacts.head(name).size
        if size != entry.size:  # checked before the archive is read into memory
            raise damaged_error(f"the archive of {entry.name} is {size} bytes, the list says {entry.size}")
        return context.artifacts.get(name)

    def follow() -> None:
        nonlocal refused, loaded
        try:
            data = context.artifacts.get(LIST_NAME)
        except NotFound:
            data = _EMPTY
        if not folder.holds(data) and data != refused:
            try:
                services = folder.install(data, fetch)
            except ConfigurationError:
                refused = data
                raise
            context.log("services", names=[service.name for service in services])
        if folder.holds(data) and data != loaded:
            try:
                context.machine.reload_services()
            except Disconnected:
                return  # no server runs; a server that starts reads the folder itself
            loaded = data

    return Task(name="services", period_s=float(LIST_POLL_PERIOD_S), call=follow, in_thread=True)
