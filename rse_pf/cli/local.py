"""Run the platform on this machine until Ctrl-C: a load balancer, and backend servers behind it.

Each is a process of its own; Ctrl-C, a closed terminal and rse-pf local stop leave nothing running.  The
platform grows, shrinks and replaces what breaks; the other actions look at it, or break it on purpose.

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
import json
import math
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError

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
    parser.add_argument("server", nargs="?", metavar="SERVER", help="whom to kill, pause, resume, slow, ...")
    parser.add_argument("--json", action="store_true", help="status: as JSON")
    parser.add_argument(
        "--for", dest="for_s", type=float, metavar="S",
        help="pause, slow, partition: over after S seconds (else: pause stays, the others until Ctrl-C)",
    )  # fmt: skip
    parser.add_argument("--percent", type=float, metavar="P", help="slow: leave the server P %% of its time")
    parser.add_argument(
        "--name", default=DEFAULT_NAME, help=f"which platform, if there are several (default: {DEFAULT_NAME})"
    )
    parser.add_argument(
        "--servers", type=int, metavar="N",
        help=f"backend servers at the start (local.servers, default {defaults.servers})",
    )  # fmt: skip
    parser.add_argument(
        "--port", type=int, metavar="P",
        help=f"front door; 0 takes a free one (local.port, default {defaults.port})",
    )  # fmt: skip
    parser.add_argument(
        "--no-data", action="store_true", help="do without the data service (large data by HTTP under /data/)"
    )
    parser.add_argument(
        "--services", metavar="DIR", help="also run the services installed there (rse-pf service install)"
    )
    parser.add_argument(
        "--accept-weak-isolation", action="store_true", help="run them even where the kernel lacks a wall"
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Start, stop, look, or break."""
    from rse_pf.local.state import state_folder

    _check(args)
    folder = state_folder(args.name, os.environ)
    if args.action == "stop":
        from rse_pf.local.shutdown import stop_platform

        stopped = stop_platform(folder)
        print(f"platform {args.name!r} {'is stopped' if stopped else 'was not running'}")
        return 0
    if args.action != "start":
        return _on_running(args, folder)
    wanted = {"servers": args.servers, "port": args.port}
    chosen = settings.replace(local={name: value for name, value in wanted.items() if value is not None})
    work = _foreground(args.name, folder, _with_services(chosen, args), data=not args.no_data)
    return asyncio.run(work)


def _with_services(settings: PlatformSettings, args: argparse.Namespace) -> PlatformSettings:
    """Return *settings* with what the options say of installed services; a changed one is refused here."""
    told: dict[str, Any] = {"accept_weak_isolation": True} if args.accept_weak_isolation else {}
    if args.services is not None:
        from rse_pf.services.custom.installed import installed_services

        folder = Path(args.services).absolute()
        installed_services(folder)
        told["folder"] = str(folder)
    return settings.replace(services=told)


def _check(args: argparse.Namespace) -> None:
    """Refuse words that the action does not take."""
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
        print(json.dumps(status, indent=2) if args.json else status_table(status))
        return 0
    if args.action == "kill-balancer":
        print(f"killed the load balancer (pid {faults.kill_balancer(state)})")
        return 0
    server = faults.find_server(state, args.server)
    signal.pthread_sigmask(signal.SIG_BLOCK, _STOPPERS)
    wait = _Patience(args.for_s)
    if args.action == "slow":
        print(f"{server.name} has {args.percent:g} % of its time; Ctrl-C ends that", flush=True)
        faults.slow_down(server.process, args.percent, wait)
        print(f"{server.name} has all of its time again")
    elif args.action == "partition":
        with faults.cut_off(server, args.name):
            print(f"{server.name} is cut off; Ctrl-C ends that", flush=True)
            wait(math.inf)
        print(f"{server.name} is reachable again")
    else:
        number = {"kill": signal.SIGKILL, "pause": signal.SIGSTOP, "resume": signal.SIGCONT}[args.action]
        count = faults.signal_tree(server.process, number)
        done = {"kill": "killed", "pause": "stopped", "resume": "let go on"}[args.action]
        print(f"{done}: {server.name} (pid {server.process.pid}, {count} processes)", flush=True)
        if args.action == "pause" and args.for_s is not None:
            wait(math.inf)
            left = faults.signal_tree(server.process, signal.SIGCONT)
            print(f"{server.name} {'goes on' if left else 'is gone: it was replaced meanwhile'}")
    return 0


class _Patience:
    """Waits, but not beyond the time that ``--for`` gave, nor beyond Ctrl-C."""

    def __init__(self, for_s: float | None) -> None:
        self._end = math.inf if for_s is None else time.monotonic() + for_s

    def __call__(self, seconds: float) -> bool:
        left_s = min(seconds, max(0.0, self._end - time.monotonic()))
        if math.isinf(left_s):
            signal.sigwait(_STOPPERS)
            return True
        return signal.sigtimedwait(_STOPPERS, left_s) is not None or time.monotonic() >= self._end


async def _foreground(name: str, folder: Any, settings: PlatformSettings, *, data: bool) -> int:
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
    cloud = LocalPlatform(
        settings, state=folder, name=name, adoptable=True, elastic=True, data=data, on_event=_show
    )
    try:
        async with cloud:
            ready = True
            _welcome(cloud, name)
            await stopped.wait()
            print("\nstopping", flush=True)
    except asyncio.CancelledError:
        print("\nstopped before it was ready", file=sys.stderr)
        return 130
    return 0


def _welcome(cloud: Any, name: str) -> None:
    from rse_pf.local.control.status import data_url

    which = "" if name == DEFAULT_NAME else f" --name {name}"
    large = f"large data goes to {data_url(cloud.url)}\n" if cloud.data_servers.is_running() else ""
    print(
        f"\nrobots connect to  {cloud.url}\n{large}"
        f"a robot's token    rse-pf token issue robot-1{which}\n"
        f"to stop            Ctrl-C, or rse-pf local stop{which}\n"
        f"logs and state     {cloud.state}\n",
        flush=True,
    )


def _show(event: Any) -> None:
    words = _WORDS.get(event["event"])
    if words is not None:
        print(words.format_map(_Told(event)), flush=True)


class _Told(dict[str, Any]):
    """An event; a list is told as words, and what it does not tell is a dash."""

    def __getitem__(self, key: str) -> Any:
        value = super().__getitem__(key)
        return ", ".join(map(str, value)) if isinstance(value, list) else value

    def __missing__(self, key: str) -> str:
        return "-"


_WORDS = {
    "adopted": "took over what an earlier control plane left: {servers}",
    "balancer-back": "the load balancer is back after {seconds} s",
    "balancer-failed": "the load balancer does not come back: {reason}",
    "balancer-gone": "the load balancer is gone: {reason}",
    "crash-loop": "servers die young: the next one starts in {wait_s} s",
    "data-server-down": "data server {name} ended ({code})",
    "data-server-failed": "data server {name} does not start: {error}",
    "data-server-silent": "data server {name} answers nobody and is ended",
    "data-server-up": "data server {name} is ready (pid {pid})",
    "drain-over": "{server} has left after {seconds} s",
    "drain-start": "{server} leaves ({reason}); its robots move",
    "grow": "{servers} more: {reason}",
    "platform-ready": "the platform is ready after {seconds:.1f} s",
    "rebalance": "{server} hands {robots} robots over",
    "replace": "{server} is replaced by {by}: {reason}",
    "server-failed": "{server} did not start: {reason}",
    "server-gone": "{server} ended (exit code {exit_code})",
    "server-ready": "{server} is ready (pid {pid})",
    "server-unhealthy": "{server} is unhealthy: {reason}",
    "shrink": "{servers} less: {reason}",
}
"""What an event is to a person."""
