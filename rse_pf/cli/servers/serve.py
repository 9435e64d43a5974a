"""Run one backend server: a supervisor, its worker processes, and a control port.

The control port answers /healthz, /readyz, /metrics and /status.  With --control-token, only the first two
are answered without that token.  SIGTERM drains the server: its robots move to other servers, and no command
is lost.  Ctrl-C stops it at once.  To run a whole platform, use rse-pf local.

example:
  rse-pf serve --keys keys.json --port 0 --announce server.json
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rse_pf.auth.control_token import read_control_token
from rse_pf.auth.trust_store import TrustStore
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings, setting_rows
from rse_pf.config.placement import ServerPlacement
from rse_pf.errors import UsageError

if TYPE_CHECKING:
    from rse_pf.server.worker_context import ServerRecorder

__all__ = ["ACTION"]

_ROWS = {(row.group, row.name): row for row in setting_rows()}


def _setting(name: str, flag: str = "") -> Any:
    """Return the option that overrides the setting *name*, written ``group.name``."""
    row = _ROWS[tuple(name.split("."))]  # type: ignore[index]
    unit = f" [{row.unit}]" if row.unit else ""
    return option(
        flag or f"--{row.name.replace('_', '-')}",
        choices=row.choices or None,
        metavar=None if row.choices else row.name.rpartition("_")[2].upper(),
        help=f"{row.doc}{unit} ({name}, default {row.default})",
    )


@dataclass(frozen=True, kw_only=True)
class ServeRequest:
    """The options of rse-pf serve: listeners, keys, recordings and services of one backend server."""

    settings: Path | None = None
    host: str | None = _setting("serving.host")
    port: int | None = _setting("serving.port")
    control_host: str | None = _setting("serving.control_host")
    control_port: int | None = _setting("serving.control_port")
    workers: int | None = _setting("serving.workers")
    store: str | None = _setting("data.store")
    live_host: str | None = _setting("live.host", "--live-host")
    emulated_cores: float | None = _setting("serving.emulated_cores")
    log_level: str | None = _setting("serving.log_level")
    keys: Path | None = option(
        "--keys",
        metavar="FILE",
        help="public keys of the tokens, a JWKS; the folder control/ next to it holds roster and deny list",
    )
    control_token: Path | None = option(
        "--control-token",
        metavar="FILE",
        help="require the token in FILE on the control port, except for its two health pages",
    )
    server_id: str | None = option(
        "--server-id", metavar="NAME", help="name of this server (default: server-PID)"
    )
    announce: Path | None = option(
        "--announce", metavar="FILE", help="write pids and ports to FILE when the server is ready"
    )
    audit: Path | None = option(
        "--audit", metavar="DIR", help="write the audit log of accepted and refused robots to DIR"
    )
    record: Path | None = option(
        "--record",
        metavar="DIR",
        help="record the messages of robots and servers in DIR, for rse-pf replay (recording.folder)",
    )
    record_key: Path | None = option(
        "--record-key",
        metavar="FILE",
        help="key of the pseudonyms in recordings, the same for all servers (default: one of its own)",
    )
    services: Path | None = option(
        "--services", metavar="DIR", help="run the services installed in DIR (services.folder)"
    )
    follow_services: Path | None = option(
        "--follow-services",
        metavar="LINK",
        help="run the services in the folder that the symbolic link LINK names, and load them again when "
        "the control port requests it (services.follow); services that cannot be loaded are left out",
    )
    accept_weak_isolation: bool = option(
        "--accept-weak-isolation",
        help="run services even if this kernel lacks a kind of isolation (services.accept_weak_isolation)",
    )
    conformance_echo: bool = option(
        "--conformance-echo", help="echo raw messages without tokens, on loopback only"
    )


_PLACEMENT = ("host", "port", "control_host", "control_port", "workers", "store", "live_host")
"""Options that override a field of `ServerPlacement`, which is otherwise that of the settings file."""
_SETTINGS = ("emulated_cores", "log_level")
"""Options that override the setting of the same name in the group serving."""


def run_server(request: ServeRequest, settings: PlatformSettings) -> int:
    """Run one backend server until it is drained or stopped by a signal, and return its exit code."""
    services: dict[str, object] = {}
    if request.services is not None and request.follow_services is not None:
        raise UsageError("--services and --follow-services exclude each other", hint="leave one of them out")
    if request.services is not None:
        services["folder"] = str(request.services.absolute())
    if request.follow_services is not None:
        services.update(folder=str(request.follow_services.absolute()), follow=True)
    if request.accept_weak_isolation:
        services["accept_weak_isolation"] = True
    chosen = settings.replace(serving=_given(request, _SETTINGS), services=services)
    if request.record is not None:
        from rse_pf.extensions.recording.writer import with_recordings

        chosen = with_recordings(chosen, request.record)
    placement = ServerPlacement.read(request.settings, chosen, **_given(request, _PLACEMENT))
    server_id = f"server-{os.getpid()}" if request.server_id is None else request.server_id
    if not 0 < len(server_id) <= 64 or not server_id.isprintable():
        raise UsageError(
            f"{server_id[:80]!r} is not a valid name of a server", hint="use 1 to 64 printable letters"
        )
    token = None if request.control_token is None else read_control_token(request.control_token)
    if request.announce is not None and not request.announce.absolute().parent.is_dir():
        raise UsageError(
            f"--announce: there is no folder {request.announce.absolute().parent}",
            hint="make it, or name another --announce",
        )
    trust = None if request.keys is None else _trust(request.keys)
    from rse_pf.server.supervisor import serve

    return serve(
        chosen,
        placement=placement,
        trust=trust,
        server_id=server_id,
        announce=request.announce,
        conformance_echo=request.conformance_echo,
        audit=request.audit,
        control_token=token,
        recorder=_recorder(chosen, server_id, request.record_key),
    )


def _recorder(settings: PlatformSettings, server_id: str, key: Path | None) -> ServerRecorder | None:
    """Return the recorder of this server; None if ``recording.folder`` is empty."""
    if not settings.recording.folder:
        return None
    from rse_pf.extensions.recording.server_recorder import FileServerRecorder

    return FileServerRecorder(settings, server_id, key)


def _given(request: ServeRequest, options: Iterable[str]) -> dict[str, object]:
    """Return the values of those *options*, by name, that the command line gives."""
    return {name: getattr(request, name) for name in options if getattr(request, name) is not None}


def _trust(keys: Path) -> TrustStore:
    """Return the store of public keys, roster and deny list for the JWKS *keys*.

    Raises:
        UsageError: The file cannot be read.
    """
    try:
        keys.open("rb").close()
    except OSError as error:
        raise UsageError(
            f"cannot read the keys {keys}: {error.strerror}",
            hint="name a JWKS; rse-pf local writes one as keys.json",
        ) from error
    return TrustStore(keys)


ACTION = Action(request=ServeRequest, run=run_server)
