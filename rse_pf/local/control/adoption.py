"""Take over the servers and the balancer of a control plane that was killed, while they serve robots.

A process in the state file that still runs, by its id and start time, keeps its name.  Nothing that runs is
killed or restarted, and the balancer keeps its port.
"""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Callable

from rse_pf.errors import ConfigurationError
from rse_pf.local.balancer.load_balancer import EnvoyLoadBalancer
from rse_pf.local.control.fleet import Fleet, Member
from rse_pf.local.processes import is_alive, send_signal
from rse_pf.local.servers.backend_servers import LocalBackendServers
from rse_pf.local.servers.control_client import ControlPort
from rse_pf.local.servers.data_servers import LocalDataServers
from rse_pf.local.state import PlatformState

__all__ = ["adopt", "adopt_data"]

_ASK_S = 1.0


async def adopt(
    state: PlatformState,
    fleet: Fleet,
    backend_servers: LocalBackendServers,
    load_balancer: EnvoyLoadBalancer,
    emit: Callable[..., None],
    end: float,
) -> None:
    """Adopt what of *state* still runs, launch what is missing, and wait until one server gets robots.

    Args:
        state: What the earlier control plane wrote.
        fleet: Empty; knows the servers afterwards.
        backend_servers: Likewise.
        load_balancer: Not launched; serves on its old port afterwards.
        emit: Gets the event ``adopted``: servers, balancer, and which settings digest each server runs.
        end: Monotonic time of the deadline.

    Raises:
        ConfigurationError: The balancer is gone and does not come back, or no server gets robots.
    """
    now_s = time.monotonic()
    balancer = state.load_balancer
    kept = balancer is not None and is_alive(balancer)
    load_balancer.adopt(balancer if kept else None, port=state.port)
    fleet.launched = state.launched
    members = []
    for server in state.servers:
        if is_alive(server.process):
            backend_servers.adopt(server.name, server.process)
            members.append(fleet.adopt(server.name, now_s=now_s, is_target=bool(server.port)))
    digests = {
        server.name: await _digest(backend_servers.control(server.control_port))
        for server in state.servers
        if server.port
    }
    emit(
        "adopted",
        servers=[member.name for member in members],
        balancer=kept,
        settings_digest=state.settings_digest,
        digests={member.name: digests.get(member.name) for member in members},
    )
    if not kept:
        load_balancer.launch()
    await load_balancer.wait_live(end - time.monotonic())
    if not members:
        members = [fleet.launch() for _ in state.servers] or [fleet.launch()]
    for member in members:
        fleet.start(member)
    await _until_one_is_healthy(members, end)


async def adopt_data(
    state: PlatformState, data_servers: LocalDataServers, load_balancer: EnvoyLoadBalancer, *, wanted: bool
) -> None:
    """Adopt the data server of *state* if it runs; start one if there is none and it is *wanted*.

    Args:
        state: What the earlier control plane wrote.
        data_servers: Not started.
        load_balancer: Told where the data server is.
        wanted: Whether a missing one is started, on its old port if that is free.

    Raises:
        ConfigurationError: It does not start.
    """
    left = state.data_server
    if left is not None and is_alive(left.process) and left.port:
        data_servers.adopt(left.process, left.port)
        load_balancer.set_data_targets([data_servers.target])
        return
    if left is not None:
        send_signal(left.process, signal.SIGKILL)  # it had not announced itself: its port is unknown
    if wanted:
        await data_servers.start(0 if left is None else left.port)


async def _until_one_is_healthy(members: list[Member], end: float) -> None:
    waiting = [asyncio.ensure_future(member.healthy.wait()) for member in members]
    try:
        left_s = max(end - time.monotonic(), 0.0)
        done, _ = await asyncio.wait(waiting, timeout=left_s, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for each in waiting:
            each.cancel()
    if not done:
        names = ", ".join(member.name for member in members)
        raise ConfigurationError(
            f"none of the adopted servers became healthy: {names}",
            hint="look at their logs, or end them with: rse-pf local stop",
        )


async def _digest(port: ControlPort) -> str | None:
    """Return the digest of the server's settings; None if it does not answer."""
    reply = await port.ask_once("/status", timeout_s=_ASK_S)
    return None if reply is None else str(reply.document().get("settings", "")) or None
