"""Run the platform on this machine until Ctrl-C: a load balancer, and backend servers behind it.

Each box is a separate process; Ctrl-C, closing the terminal and rse-pf local stop end all of them.  The
platform grows, shrinks and replaces what breaks.  The other actions show its state, or inject a fault.

examples:
  rse-pf local --servers 2
  rse-pf local status
  rse-pf local pause server-1 --for 5
  rse-pf local slow server-2 --percent 10 --for 30
  rse-pf local stop
"""

from __future__ import annotations

import argparse
import asyncio
import collections
import functools
import math
import os
import signal
import time
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.terminal import show, show_json, show_page

__all__ = ["DEFAULT_NAME", "add_arguments", "run"]

DEFAULT_NAME = "default"
_FAULTS = ("kill", "pause", "resume", "slow", "partition")
_ACTIONS = ("start", "stop", "status", *_FAULTS, "kill-balancer")
_SAMPLE_S = 0.5
_STOPPERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    defaults = PlatformSettings().local
    parser.add_argument(
        "action", nargs="?", choices=_ACTIONS, default="start", help="what to do (default: start)"
    )
    parser.add_argument(
        "server", nargs="?", metavar="SERVER", help="the server to kill, pause, resume, slow, ..."
    )
    parser.add_argument("--json", action="store_true", help="status: as JSON")
    parser.add_argument(
        "--for", dest="for_s", type=float, metavar="S",
        help="pause, slow, partition: end after S seconds (without: pause stays, the others end with Ctrl-C)",
    )  # fmt: skip
    parser.add_argument(
        "--percent", type=float, metavar="P", help="slow: leave the server P %% of its CPU time"
    )
    parser.add_argument(
        "--name", default=DEFAULT_NAME, help=f"name of the platform, if several run (default: {DEFAULT_NAME})"
    )
    parser.add_argument(
        "--servers", type=int, metavar="N",
        help=f"backend servers at the start (local.servers, default {defaults.servers})",
    )  # fmt: skip
    parser.add_argument(
        "--port", type=int, metavar="P",
        help=f"port that robots connect to; 0 takes a free one (local.port, default {defaults.port})",
    )  # fmt: skip
    parser.add_argument(
        "--no-data", action="store_true", help="start no data service (large data by HTTP under /data/)"
    )
    parser.add_argument(
        "--services", metavar="DIR", help="also run the services installed there (rse-pf service install)"
    )
    parser.add_argument(
        "--accept-weak-isolation",
        action="store_true",
        help="run them even if the kernel lacks a kind of isolation",
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Start or stop a platform, show its state, or inject a fault."""
    from rse_pf.local.state import state_folder

    _check(args)
    folder = state_folder(args.name, os.environ)
    if args.action == "stop":
        from rse_pf.local.state import stop_platform

        stopped = stop_platform(folder)
        show(f"platform {args.name!r} {'is stopped' if stopped else 'was not running'}")
        return 0
    if args.action != "start":
        return _on_running(args, folder)
    wanted = {"servers": args.servers, "port": args.port}
    chosen = settings.replace(local={name: value for name, value in wanted.items() if value is not None})
    work = _foreground(args.name, folder, _with_services(chosen, args), data=not args.no_data)
    return asyncio.run(work)


def _with_services(settings: PlatformSettings, args: argparse.Namespace) -> PlatformSettings:
    """Return *settings* with the options for installed services; raises UsageError for a damaged service."""
    changes: dict[str, Any] = {"accept_weak_isolation": True} if args.accept_weak_isolation else {}
    if args.services is not None:
        from rse_pf.services.custom.installed import installed_services

        folder = Path(args.services).absolute()
        installed_services(folder)
        changes["folder"] = str(folder)
    return settings.replace(services=changes)


def _check(args: argparse.Namespace) -> None:
    """Raise UsageError for options that the action does not take."""
    if args.action in _FAULTS and args.server is None:
        raise UsageError(
            f"rse-pf local {args.action} needs a server", hint="rse-pf local status shows their names"
        )
    if args.action not in _FAULTS and args.server is not None:
        raise UsageError(f"rse-pf local {args.action} takes no server", hint="leave the name out")
    if args.for_s is not None and (args.action not in ("pause", "slow", "partition") or not args.for_s > 0):
        raise UsageError(
            "--for takes a positive number of seconds, for pause, slow and partition", hint="leave it out"
        )
    if (args.percent is not None) != (args.action == "slow"):
        raise UsageError("--percent belongs to slow, and slow needs it", hint="for example: --percent 10")


def _on_running(args: argparse.Namespace, folder: Any) -> int:
    from rse_pf.local.control.status import platform_status, status_table
    from rse_pf.local.faults import faults
    from rse_pf.local.state import read_state

    state = read_state(folder)
    if state is None:
        raise UsageError(f"platform {args.name!r} is not running", hint="start it with: rse-pf local")
    if args.action == "status":
        status = asyncio.run(platform_status(state, sample_s=_SAMPLE_S))
        if args.json:
            show_json(status, indent=2)
        else:
            show_page(status_table(status))
        return 0
    if args.action == "kill-balancer":
        show(f"killed the load balancer (pid {faults.kill_balancer(state)})")
        return 0
    server = faults.find_server(state, args.server)
    signal.pthread_sigmask(signal.SIG_BLOCK, _STOPPERS)
    wait = functools.partial(_wait, math.inf if args.for_s is None else time.monotonic() + args.for_s)
    if args.action == "slow":
        show(f"{server.name} has {args.percent:g} % of its time; Ctrl-C ends that")
        faults.slow_down(server.process, args.percent, wait)
        show(f"{server.name} has all of its time again")
    elif args.action == "partition":
        with faults.cut_off(server, args.name):
            show(f"{server.name} is cut off; Ctrl-C ends that")
            wait(math.inf)
        show(f"{server.name} is reachable again")
    else:
        number = {"kill": signal.SIGKILL, "pause": signal.SIGSTOP, "resume": signal.SIGCONT}[args.action]
        count = faults.signal_tree(server.process, number)
        done = {"kill": "killed", "pause": "stopped", "resume": "let go on"}[args.action]
        show(f"{done}: {server.name} (pid {server.process.pid}, {count} processes)")
        if args.action == "pause" and args.for_s is not None:
            wait(math.inf)
            left = faults.signal_tree(server.process, signal.SIGCONT)
            show(f"{server.name} {'goes on' if left else 'is gone: it was replaced meanwhile'}")
    return 0


def _wait(end_s: float, seconds: float) -> bool:
    """Wait *seconds*, but not past *end_s* (monotonic) or a signal; return whether one of these came."""
    left_s = min(seconds, max(0.0, end_s - time.monotonic()))
    if math.isinf(left_s):
        signal.sigwait(_STOPPERS)
        return True
    return signal.sigtimedwait(_STOPPERS, left_s) is not None or time.monotonic() >= end_s


async def _foreground(name: str, folder: Any, settings: PlatformSettings, *, data: bool) -> int:
    from rse_pf.local.control.control_plane import ControlOptions
    from rse_pf.local.control.platform import LocalPlatform

    stopped = asyncio.Event()
    loop = asyncio.get_running_loop()
    this = asyncio.current_task()
    assert this is not None

    def leave() -> None:
        if not stopped.is_set():
            stopped.set()
            if not ready:
                this.cancel()

    ready = False
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, leave)
    platform = LocalPlatform(
        settings,
        state=folder,
        name=name,
        adoptable=True,
        data=data,
        on_event=_show,
        control=ControlOptions(elastic=True),
    )
    try:
        async with platform:
            ready = True
            _welcome(platform, name)
            await stopped.wait()
            show("", "stopping")
    except asyncio.CancelledError:
        show("", "stopped before it was ready", error=True)
        return 130
    return 0


def _welcome(platform: Any, name: str) -> None:
    from rse_pf.local.control.status import data_url

    which = "" if name == DEFAULT_NAME else f" --name {name}"
    has_data = platform.data_servers.process.is_running()
    show(
        "",
        f"robots connect to  {platform.url}",
        *([f"large data goes to {data_url(platform.url)}"] if has_data else []),
        f"a robot's token    rse-pf token issue robot-1{which}",
        f"to stop            Ctrl-C, or rse-pf local stop{which}",
        f"logs and state     {platform.state}",
        "",
    )


def _show(event: Any) -> None:
    text = _TEXTS.get(event["event"])
    if text is not None:
        values = {
            key: ", ".join(map(str, value)) if isinstance(value, list) else value
            for key, value in event.items()
        }
        show(text.format_map(collections.defaultdict(lambda: "-", values)))


_TEXTS = {
    "adopted": "adopted from an earlier control plane: {servers}",
    "balancer-back": "the load balancer is back after {seconds} s",
    "balancer-failed": "the load balancer does not start: {reason}",
    "balancer-gone": "the load balancer ended: {reason}",
    "crash-loop": "servers end too soon after their start: the next one starts in {wait_s} s",
    "data-server-down": "data server {name} ended ({code})",
    "data-server-failed": "data server {name} does not start: {error}",
    "data-server-silent": "data server {name} does not answer and is killed",
    "data-server-up": "data server {name} is ready (pid {pid})",
    "drain-over": "{server} has left after {seconds} s",
    "drain-start": "{server} drains ({reason}); its robots move",
    "grow": "{servers} more: {reason}",
    "not-written": "{reason}",
    "platform-ready": "the platform is ready after {seconds:.1f} s",
    "rebalance": "{robots} robots of {server} are asked to move",
    "replace": "{server} is replaced by {by}: {reason}",
    "server-failed": "{server} did not start: {reason}",
    "server-gone": "{server} ended (exit code {exit_code})",
    "server-ready": "{server} is ready (pid {pid})",
    "server-unhealthy": "{server} is unhealthy: {reason}",
    "shrink": "{servers} less: {reason}",
}
"""The line for each event; an event without a line is not shown."""
