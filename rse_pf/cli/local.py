"""Run the platform on this machine until Ctrl-C: a load balancer, and backend servers behind it.

Each is a process of its own; Ctrl-C, a closed terminal and rse-pf local stop leave nothing running.

examples:
  rse-pf local --servers 2
  rse-pf local stop
"""

from __future__ import annotations

import argparse
import asyncio
import os
import signal
import sys
from typing import Any

from rse_pf.errors import RsePfError
from rse_pf.settings import PlatformSettings

__all__ = ["DEFAULT_NAME", "add_arguments", "run"]

DEFAULT_NAME = "default"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    defaults = PlatformSettings().local
    parser.add_argument(
        "action", nargs="?", choices=("start", "stop"), default="start", help="what to do (default: start)"
    )
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


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Start, or stop."""
    from rse_pf.local.state import state_folder

    folder = state_folder(args.name, os.environ)
    if args.action == "stop":
        from rse_pf.local.stopping import stop_platform

        stopped = stop_platform(folder, settings.local.stop_timeout_s)
        print(f"platform {args.name!r} {'is stopped' if stopped else 'was not running'}")
        return 0
    wanted = {"servers": args.servers, "port": args.port}
    chosen = settings.replace(local={name: value for name, value in wanted.items() if value is not None})
    return asyncio.run(_foreground(args.name, folder, chosen))


async def _foreground(name: str, folder: Any, settings: PlatformSettings) -> int:
    from rse_pf.local.cloud import LocalCloud

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
    cloud = LocalCloud(settings, state=folder, name=name, adoptable=True, on_event=_show)
    try:
        async with cloud:
            ready = True
            _welcome(cloud, name)
            await _until_over(cloud, stopped)
            print("\nstopping", flush=True)
    except asyncio.CancelledError:
        print("\nstopped before it was ready", file=sys.stderr)
        return 130
    return 0


async def _until_over(cloud: Any, stopped: asyncio.Event) -> None:
    asked = asyncio.create_task(stopped.wait())
    balancer = asyncio.create_task(cloud.load_balancer.wait_over())
    try:
        await asyncio.wait((asked, balancer), return_when=asyncio.FIRST_COMPLETED)
        if balancer.done() and not stopped.is_set():
            raise RsePfError(
                f"the load balancer ended: {balancer.result()}", hint=f"its log is {cloud.load_balancer.log}"
            )
    finally:
        asked.cancel()
        balancer.cancel()
        await asyncio.gather(asked, balancer, return_exceptions=True)


def _welcome(cloud: Any, name: str) -> None:
    which = "" if name == DEFAULT_NAME else f" --name {name}"
    print(
        f"\nrobots connect to  {cloud.url}\n"
        f"a robot's token    rse-pf token issue robot-1{which}\n"
        f"to stop            Ctrl-C, or rse-pf local stop{which}\n"
        f"logs and state     {cloud.state}\n",
        flush=True,
    )


def _show(event: Any) -> None:
    if event["event"] == "server-ready":
        print(f"{event['server']} is ready (pid {event['pid']})", flush=True)
    elif event["event"] == "server-gone":
        print(f"{event['server']} ended (exit code {event['exit_code']})", flush=True)
    elif event["event"] == "platform-ready":
        print(f"the platform is ready after {event['seconds']:.1f} s", flush=True)
