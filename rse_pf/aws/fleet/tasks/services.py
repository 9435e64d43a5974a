"""Follow the list of published services: fetch what it names, check it, and let the server load it.

The agent only reads the bucket; operators write it with ``rse-pf service publish``.  A list that is refused
changes nothing, and is tried again when it has changed.
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
"""Folder of the services in the agent's state folder; the systemd units name it, too."""
_EMPTY = msgspec.json.encode(PublishedList())


def task(context: AgentContext) -> Task:
    """Install the services of the list if it changed, and have the server load them."""
    folder = PublishedFolder(context.config.state_folder / FOLDER)
    refused, loaded = b"", b""

    def fetch(entry: PublishedService) -> bytes:
        name = archive_name(entry.archive)
        size = context.artifacts.head(name).size
        if size != entry.size:  # before it is read into memory
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
                return  # a server that starts reads the folder itself
            loaded = data

    return Task(name="services", period_s=float(LIST_POLL_PERIOD_S), call=follow, in_thread=True)
