"""Show and lift the refusals of services after crashes: rse-pf service status and service unblock.

A server that refuses a service, or a request to it, to a robot, a tenant or all robots has a *block*.  Every
server decides about its blocks by itself, so each is asked on its control port: all servers of a local
platform, or the one whose port is named.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

from rse_pf.auth.control_token import read_control_token
from rse_pf.command_line.options import option
from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed, UsageError
from rse_pf.identity import DEFAULT_TENANT
from rse_pf.local.servers.control_client import ControlPort, ControlPortReply
from rse_pf.local.state import read_state, state_folder
from rse_pf.terminal import show

__all__ = ["Server", "ServersRequest", "UnblockRequest", "choose_servers", "show_blocks", "unblock"]

# Time limit of the request to a server, in seconds.
_TIMEOUT_S = 5.0
# Host names of this machine that --url may have: control ports are on loopback.
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_COLUMNS = ("server", "service", "refused to", "because of", "for another")
Server = tuple[str, int, str | None]
"""A backend server: its name, its control port, and the token of that port, None if it requires none."""


@dataclass(frozen=True, kw_only=True)
class ServersRequest:
    """The options that name the servers: those of a local platform, or one by its control port."""

    name: str = option("--name", default="default", help="name of the local platform (default: %(default)s)")
    control_port: int | None = option(
        "--control-port",
        metavar="PORT",
        help="ask the server on this machine with this control port, not a local platform",
    )
    control_token: Path | None = option(
        "--control-token", metavar="FILE", help="token file of the server with --control-port"
    )
    url: str | None = option("--url", help="the same as --control-port, as in http://127.0.0.1:PORT")


@dataclass(frozen=True, kw_only=True)
class UnblockRequest(ServersRequest):
    """The options that select refusals of services to lift: by service, tenant and robot; none means all."""

    service: str | None = option(nargs="?", metavar="SERVICE", help="only this service (default: all)")
    tenant: str | None = option(
        "--tenant", help=f"only for this tenant (with --robot, default: {DEFAULT_TENANT})"
    )
    robot: str | None = option("--robot", metavar="NAME", help="only for this robot of the tenant")


def show_blocks(request: ServersRequest, settings: PlatformSettings) -> int:
    """Print each refusal: service, robot or tenant, cause, time left; return 1 if a server did not answer.

    Raises:
        CommandFailed: No server answered, or one answered with an error.
    """
    answers, silent = asyncio.run(_ask_all(choose_servers(request), "GET", "/blocks"))
    rows = [_row(server, block) for server, answer in answers for block in answer["blocks"]]
    left_out = sum(answer["count"] - len(answer["blocks"]) for _, answer in answers)
    if rows:
        _show_table([_COLUMNS, *rows])
    elif answers:
        show("no service and no request is refused")
    if left_out:
        show(f"and {left_out} more")
    return _show_silent(silent, answers)


def unblock(request: UnblockRequest, settings: PlatformSettings) -> int:
    """Lift the refusals that the options select, and print each; return 1 if a server did not answer.

    Raises:
        CommandFailed: No server answered, or one answered with an error.
    """
    tenant = request.tenant or (DEFAULT_TENANT if request.robot else None)
    wanted = {"service": request.service, "tenant": tenant, "robot": request.robot}
    query = urlencode({name: value for name, value in wanted.items() if value})
    target = f"/unblock?{query}" if query else "/unblock"
    answers, silent = asyncio.run(_ask_all(choose_servers(request), "POST", target))
    for server, answer in answers:
        for block in answer["blocks"]:
            _, service, whom, why, _ = _row(server, block)
            show(f"{server}: {service} is no longer refused to {whom} ({why})")
        left_out = answer["count"] - len(answer["blocks"])
        if left_out:
            show(f"{server}: and {left_out} more")
    if answers and not any(answer["count"] for _, answer in answers):
        show("nothing was refused that could be lifted")
    return _show_silent(silent, answers)


def choose_servers(request: ServersRequest) -> list[Server]:
    """Return the servers that the options name: those of a platform, or one by its control port.

    Raises:
        UsageError: No server of the platform runs, the port or the address is not valid, or the token's file
            cannot be read.
    """
    named = request.control_port if request.url is None else _port_of(request.url)
    if named is not None:
        if not 0 < named < 65536:
            raise UsageError(f"{named} is not a port", hint="name a port from 1 to 65535")
        token = None if request.control_token is None else read_control_token(request.control_token)
        return [(f"port {named}", named, token)]
    state = read_state(state_folder(request.name, os.environ))
    servers = [] if state is None else [server for server in state.servers if server.control_port]
    if state is None or not servers:
        raise UsageError(
            f"no server of a platform named {request.name!r} is running",
            hint="start one with: rse-pf local; for a server of rse-pf serve, name its --control-port",
        )
    token = read_control_token(Path(state.control_token_file)) if state.control_token_file else None
    return [(server.name, server.control_port, token) for server in servers]


def _port_of(url: str) -> int:
    """Return the port in *url*, an http address of this machine; raises UsageError for any other."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if host not in _LOOPBACK or port is None or parts.scheme != "http":
        raise UsageError(
            f"{url[:80]!r} is not a control port of this machine",
            hint="write --url http://127.0.0.1:PORT, on the machine of the server",
        )
    return port


async def _ask_all(
    servers: Sequence[Server], method: str, target: str
) -> tuple[list[tuple[str, dict[str, Any]]], list[str]]:
    """Send a request to each of *servers* at the same time.

    Returns the name and the JSON answer of each server that answered, and the names of those that did not.  A
    server whose workers answered only in part is in both.
    """
    replies = await asyncio.gather(
        *(
            ControlPort(port, token).ask_once(target, timeout_s=_TIMEOUT_S, method=method)
            for _, port, token in servers
        )
    )
    answers, silent = [], []
    for (name, _, _), reply in zip(servers, replies, strict=True):
        document = None if reply is None else _document(name, reply)
        if document is None:
            silent.append(name)
            continue
        answers.append((str(document["server"]), document))
        if document["silent_workers"]:
            silent.append(f"{document['silent_workers']} workers of {name}")
    return answers, silent


def _document(name: str, reply: ControlPortReply) -> dict[str, Any] | None:
    """Return the answer in *reply* of server *name*; None if it is incomplete.

    Raises:
        UsageError: The server requires a token.
        CommandFailed: The server answered with another error.
    """
    document = reply.document()
    if reply.status == 401:
        raise UsageError(f"{name} requires a token", hint="name the file of the token with --control-token")
    if reply.status == 404:
        raise CommandFailed(f"{name} is of an earlier version", hint="roll the servers to this version")
    if reply.status != 200:
        raise CommandFailed(
            f"{name} answers {reply.status}", hint=str(document.get("hint", "see the server's log"))
        )
    return document if {"server", "blocks", "count", "silent_workers"} <= set(document) else None


def _show_silent(silent: Sequence[str], answers: Sequence[Any]) -> int:
    """Print the names of *silent* servers; return 1 if there are any, else 0.

    Raises:
        CommandFailed: No server answered.
    """
    if not answers:
        raise CommandFailed(
            f"no answer from {', '.join(silent)}", hint="see rse-pf local status and the logs of the servers"
        )
    for name in silent:
        show(f"no answer from {name}", error=True)
    return 1 if silent else 0


def _row(server: str, block: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the cells of `_COLUMNS` for a block of *server*."""
    tenant, robot, requests = block["tenant"], block["robot"], block["requests"]
    whom = f"robot {tenant}/{robot}" if robot else f"tenant {tenant}" if tenant else "all robots"
    why = {
        "crashes": "crashes",
        "overruns": "overrun deadlines",
        "poison": f"{requests} poison request{'s' if requests > 1 else ''}",
    }[block["reason"]]
    return server, str(block["service"]), whom, why, f"{block['left_s']:.0f} s"


def _show_table(rows: Sequence[tuple[str, ...]]) -> None:
    widths = [max(len(row[column]) for row in rows) for column in range(len(_COLUMNS))]
    for row in rows:
        show("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
