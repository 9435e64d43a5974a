"""Inject faults into a running platform: kill, stop, slow down or cut off one of its processes.

The functions need only the state file of the platform, so that they work while its control plane is not
running. They signal only processes whose id and start time are in that file, and the children of those.  A
server that was slowed down or cut off works again when the call returns; the network rules of `cut_off` are
removed even if this process is killed.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from rse_pf.config import HealthSettings
from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.local.processes import ProcessMark, is_alive, mark_of, send_signal
from rse_pf.local.servers.watched_server import CHECK_S
from rse_pf.local.state import PlatformState, ServerState
from rse_pf.scaling.health import LOCAL_INTERVAL_S

__all__ = [
    "cut_off",
    "find_server",
    "kill_balancer",
    "longest_pause_s",
    "nft_commands",
    "signal_tree",
    "slow_down",
    "tree",
]

PERIOD_S = 0.04
"""Seconds of one cycle of stopping and continuing a slowed server.

A cycle is long compared with a context switch and short compared with the interval of health checks."""


def find_server(state: PlatformState, name: str) -> ServerState:
    """Return the running server called *name*.

    Raises:
        UsageError: No server of this name is running; the hint names those that are.
    """
    alive = [server for server in (*state.servers, *state.single_servers) if is_alive(server.process)]
    for server in alive:
        if server.name == name:
            return server
    running = ", ".join(server.name for server in alive) or "none"
    raise UsageError(f"no server named {name[:80]!r} is running", hint=f"running: {running}")


def longest_pause_s(state: PlatformState, server: ServerState, health: HealthSettings) -> float:
    """Return for how many seconds *server* may be stopped before the control plane may replace it.

    The result is infinite if no control plane is running, since then no server is replaced.
    """
    if not is_alive(state.control_plane):
        return math.inf
    is_single = server.name in {single.name for single in state.single_servers}
    return health.unhealthy_checks * (CHECK_S if is_single else LOCAL_INTERVAL_S)


def tree(root: ProcessMark) -> list[ProcessMark]:
    """Return *root* and all its running descendants, parents before children; empty if *root* has exited."""
    marks, pids = [root] if is_alive(root) else [], {root.pid}
    for mark in marks:  # the loop appends children to the list that it iterates over
        for pid in _children(mark.pid):
            child = mark_of(pid)
            if child is not None and pid not in pids:
                pids.add(pid)
                marks.append(child)
    return marks if is_alive(root) else []


def signal_tree(root: ProcessMark, number: signal.Signals) -> int:
    """Send signal *number* to *root* and all its descendants.

    Return the number of processes that were signalled.  The search is repeated until it finds no further
    process: one may start another before it is stopped.
    """
    signalled: set[ProcessMark] = set()
    while new := [mark for mark in tree(root) if mark not in signalled]:
        for mark in new:
            send_signal(mark, number)
        signalled.update(new)
    return len(signalled)


def kill_balancer(state: PlatformState) -> int:
    """Kill the load balancer with SIGKILL and return its pid; raises UsageError if none is running."""
    mark = state.load_balancer
    if mark is None or not send_signal(mark, signal.SIGKILL):
        raise UsageError("no load balancer is running", hint="rse-pf local status shows what runs")
    return mark.pid


def slow_down(root: ProcessMark, percent: float, wait: Callable[[float], bool]) -> None:
    """Let *root* and its descendants run only *percent* of the time, until *wait* returns True.

    The call returns earlier if *root* exits.  The processes are stopped and continued by signals in cycles of
    `PERIOD_S`; they run when the call returns.

    Args:
        root: The process of a server.
        percent: Part of each cycle in which the processes run; above 0, below 100.
        wait: Waits for the given number of seconds or less; returns True to end the slow-down.

    Raises:
        UsageError: *percent* is out of range.
    """
    if not 0 < percent < 100:
        raise UsageError(f"a server cannot have {percent:g} % of its time", hint="choose 1 to 99")
    running_s = PERIOD_S * percent / 100
    try:
        while signal_tree(root, signal.SIGSTOP):
            over = wait(PERIOD_S - running_s)
            signal_tree(root, signal.SIGCONT)
            if over or wait(running_s):
                return
    finally:
        signal_tree(root, signal.SIGCONT)


@contextlib.contextmanager
def cut_off(server: ServerState, platform: str) -> Iterator[None]:
    """Drop all TCP packets to and from the ports of *server* on the loopback interface, inside the block.

    The nftables rules are in a table that is owned by a child process of this one: Linux removes the table
    when the child exits.

    Raises:
        UsageError: This process does not run as root.
        ConfigurationError: ``nft`` is not installed, or rejects the rules.
    """
    if os.geteuid() != 0:
        hint = f"nearest without root: rse-pf local pause {server.name}"
        raise UsageError("a partition needs root", hint=hint)
    path = shutil.which("nft", path=f"{os.environ.get('PATH', '')}{os.pathsep}/usr/sbin")
    if path is None:
        raise ConfigurationError("there is no nft here", hint="install nftables, or use pause")
    commands = nft_commands(f"rse_pf_{platform}_{server.name}", [server.port, server.control_port])
    child = subprocess.Popen(
        [path, "--interactive"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, start_new_session=True,
    )  # fmt: skip
    try:
        assert child.stdin is not None
        child.stdin.write(commands)
        child.stdin.flush()
        _wait_for_rules(child)
        yield
    finally:
        child.kill()
        child.communicate()


def nft_commands(table: str, ports: Sequence[int]) -> str:
    """Return the nft commands that create and list *table*, which drops TCP to and from *ports* on loopback.

    Its flag ``owner`` removes the table when the process that created it exits.  Ports that are 0 are left
    out.
    """
    name = "".join(letter if letter.isalnum() else "_" for letter in table)
    chosen = ", ".join(str(port) for port in ports if port)
    return (
        f"add table inet {name} {{ flags owner; }}\n"
        f"add chain inet {name} cut {{ type filter hook input priority -10; policy accept; }}\n"
        f'add rule inet {name} cut iifname "lo" tcp dport {{ {chosen} }} drop\n'
        f'add rule inet {name} cut iifname "lo" tcp sport {{ {chosen} }} drop\n'
        f"list table inet {name}\n"
    )


def _wait_for_rules(child: subprocess.Popen[str]) -> None:
    """Wait until the two rules of `nft_commands`, to and from the ports of the server, drop packets.

    The output of *child*, nft, is read until its last command has listed both rules; there is no time limit.

    Raises:
        ConfigurationError: nft reports an error, or exits.
    """
    assert child.stdout is not None
    rules = 0
    for line in child.stdout:
        rules += line.rstrip().endswith("drop") and "port" in line and "add rule" not in line
        if rules == 2:
            return
        if "Error" in line:
            raise ConfigurationError(
                f"nft rejects the rules: {line.strip()[:200]}", hint="does the kernel have nf_tables?"
            )
    raise ConfigurationError("nft exited without adding the rules", hint="does the kernel have nf_tables?")


def _children(pid: int) -> list[int]:
    pids: list[int] = []
    with contextlib.suppress(OSError):  # the process may have exited by now
        for path in Path(f"/proc/{pid}/task").glob("*/children"):
            with contextlib.suppress(OSError):
                pids += map(int, path.read_text(encoding="ascii").split())
    return pids
