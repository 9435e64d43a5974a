"""Describe the data server (a box of Fig. 2) and the rosbridge server; a local platform has one of each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rse_pf.audit.log import audit_folder
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import HEALTH_PATH
from rse_pf.local.firewall import key_set_file
from rse_pf.local.servers.backend_servers import RSE_PF
from rse_pf.local.servers.watched_server import WatchedServer
from rse_pf.local.state import settings_file

__all__ = ["local_data_server", "local_rosbridge_server"]

_LOOPBACK = "127.0.0.1"


def local_data_server(
    settings: PlatformSettings,
    *,
    folder: Path,
    store: str | None = None,
    program: Sequence[str] = RSE_PF,
    **options: Any,
) -> WatchedServer:
    """Return the data server of the platform in *folder*; it is not started.

    Args:
        settings: Settings, of which the groups health and local are read here.
        folder: State folder, with the files of settings and public keys that the server reads.
        store: Object store in place of ``data.store``, such as a folder instead of ``memory:``; None keeps
            it.
        program: The command to which ``data`` and its options are appended.
        options: Further arguments of `WatchedServer`.
    """
    command = [
        *program, "data", "--settings", str(settings_file(folder)), "--keys", str(key_set_file(folder)),
        "--host", _LOOPBACK, "--audit", str(audit_folder(folder)),
        *(() if store is None else ("--store", store)),
    ]  # fmt: skip
    return WatchedServer(
        "data-1", folder=folder, command=command, event="data-server", ready="/data/readyz",
        alive=f"/data{HEALTH_PATH}", unhealthy_checks=settings.health.unhealthy_checks,
        start_timeout_s=settings.local.start_timeout_s, **options,
    )  # fmt: skip


def local_rosbridge_server(
    settings: PlatformSettings, *, folder: Path, url: str, program: Sequence[str] = RSE_PF, **options: Any
) -> WatchedServer:
    """Return the rosbridge server of the platform in *folder*; it is not started.

    Args:
        settings: Settings, of which the groups health and local are read here.
        folder: State folder, with the file of settings that the server reads.
        url: Address of the load balancer on loopback, to which the server connects for its clients.
        program: The command to which ``rosbridge`` and its options are appended.
        options: Further arguments of `WatchedServer`.
    """
    command = [
        *program, "rosbridge", "--settings", str(settings_file(folder)), "--url", url, "--host", _LOOPBACK,
    ]  # fmt: skip
    return WatchedServer(
        "rosbridge-1", folder=folder, command=command, event="rosbridge", ready=HEALTH_PATH,
        alive=HEALTH_PATH, unhealthy_checks=settings.health.unhealthy_checks,
        start_timeout_s=settings.local.start_timeout_s, **options,
    )  # fmt: skip
