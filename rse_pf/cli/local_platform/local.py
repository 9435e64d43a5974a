"""Run the platform on this machine until Ctrl-C: a load balancer, and backend servers behind it.

Each box is a separate process; Ctrl-C, closing the terminal and rse-pf local stop end all of them.  The
platform grows, shrinks and replaces what breaks.  --lan opens it to the machines of this network, by TLS and
with tokens.  The other actions show its state, replace servers without loss, or inject a fault: a server that
is stopped, slow or cut off for too long is replaced.

examples:
  rse-pf local --servers 2
  rse-pf local --lan
  rse-pf local --record recordings
  rse-pf local --burst
  rse-pf local --rosbridge
  rse-pf local status
  rse-pf local robots
  rse-pf local logs --server server-1 --follow
  rse-pf local logs --since 5m --level warning
  rse-pf local events --follow --json
  rse-pf local drain server-1
  rse-pf local roll
  rse-pf local roll --settings settings.json
  rse-pf local pause server-1 --for 0.3
  rse-pf local slow server-2 --percent 10 --for 30
  rse-pf local stop
"""

from __future__ import annotations

import argparse
import asyncio
import functools
import math
import os
import signal
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NamedTuple

from rse_pf.command_line.extras import require
from rse_pf.config import HealthSettings, PlatformSettings
from rse_pf.config.resource_names import ROBOTS_PATH, ROSBRIDGE_PATH
from rse_pf.errors import UsageError
from rse_pf.terminal import show, show_json, show_page

__all__ = ["DEFAULT_NAME", "add_arguments", "run"]

DEFAULT_NAME = "default"
# Port on loopback of the burst function, unless --burst names another one.
_BURST_PORT = 8702
_FAULTS = ("kill", "pause", "resume", "slow", "partition")
_OF_A_SERVER = (*_FAULTS, "drain")
_OF_LOGS = ("logs", "events")
_ACTIONS = ("start", "stop", "status", "robots", *_OF_LOGS, "drain", "roll", *_FAULTS, "kill-balancer")
_LINES = 100
_FOLLOW_S = 0.2
_SAMPLE_S = 0.5
_STOPPERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    defaults = PlatformSettings().local
    parser.add_argument(
        "action", nargs="?", choices=_ACTIONS, default="start", metavar="ACTION",
        help=f"what to do: {', '.join(_ACTIONS)} (default: start)",
    )  # fmt: skip
    parser.add_argument(
        "server", nargs="?", metavar="SERVER", help="the server to drain, kill, pause, resume, slow, ..."
    )
    parser.add_argument("--json", action="store_true", help="status, robots, logs, events: as JSON")
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
        "--lan", nargs="?", const="", metavar="ADDRESS",
        help="listen on ADDRESS of this machine (default: a detected one) with TLS, for other machines",
    )  # fmt: skip
    parser.add_argument(
        "--metrics-port", type=int, metavar="P",
        help="port on loopback of the metrics of all servers; 0 takes a free one (local.metrics_port, "
        f"default {defaults.metrics_port})",
    )  # fmt: skip
    logs = parser.add_argument_group("logs and events")
    logs.add_argument("--server", dest="of_server", metavar="ID", help="of this process only")
    logs.add_argument("--follow", action="store_true", help="go on with new lines until Ctrl-C")
    logs.add_argument(
        "--since", metavar="TIME", help='all lines of the last 90s, 5m, 2h or 1d, or since "2026-03-01 14:30"'
    )
    logs.add_argument("--robot", default="", metavar="NAME", help="lines about this robot only")
    logs.add_argument("--tenant", default="", metavar="NAME", help="lines about this tenant only")
    logs.add_argument(
        "--level", choices=("debug", "info", "warning", "error"), default="debug",
        help="lines of at least this level (default: all)",
    )  # fmt: skip
    parser.add_argument("--no-page", action="store_true", help="start no fleet page")
    parser.add_argument(
        "--burst", nargs="?", type=int, const=0, metavar="P",
        help="also run the burst function, at port P on loopback (default "
        f"{_BURST_PORT}): robots ask it while no server answers in time",
    )  # fmt: skip
    parser.add_argument(
        "--rosbridge", action="store_true",
        help="also serve rosbridge v2 clients, on the path /rosbridge (serving.rosbridge)",
    )  # fmt: skip
    parser.add_argument(
        "--no-data", action="store_true", help="start no data service (large data by HTTP under /data/)"
    )
    parser.add_argument(
        "--record", type=Path, metavar="DIR",
        help="record what robots and servers say in DIR, for rse-pf replay (recording.folder)",
    )  # fmt: skip
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
    if args.action in _OF_LOGS:
        return _logs(args, folder)
    if args.action != "start":
        return _on_running(args, folder)
    require("local")
    from rse_pf.cli.local_platform.lan import chosen_address
    from rse_pf.extensions.recording.writer import with_recordings

    overrides = {"servers": args.servers, "port": args.port, "metrics_port": args.metrics_port}
    chosen = settings.replace(local={name: value for name, value in overrides.items() if value is not None})
    chosen = with_recordings(_with_services(chosen, args), args.record)
    if args.rosbridge:
        chosen = chosen.replace(serving={"rosbridge": True})
    lan = chosen_address(args.lan)
    page = not args.no_page
    burst_port = None if args.burst is None else args.burst or _BURST_PORT
    if burst_port is not None:
        chosen = _with_burst(chosen, burst_port, lan)
    return asyncio.run(
        _foreground(
            args.name, folder, chosen, data=not args.no_data, lan=lan,
            extras=_Extras(page=page, burst_port=burst_port),
        )
    )  # fmt: skip


def _with_burst(settings: PlatformSettings, port: int, lan: str) -> PlatformSettings:
    """Return *settings* whose servers tell robots of the burst function at *port*."""
    from rse_pf.config.front_door import BURST_PATH
    from rse_pf.local.firewall import check_listener

    if lan:
        raise UsageError(
            "--burst is for robots of this machine, and --lan for others", hint="leave one of them out"
        )
    if not 0 < port < 65536:
        raise UsageError(f"--burst {port} is not a port", hint="name one from 1 to 65535, or leave it out")
    check_listener("127.0.0.1", port)
    return settings.replace(burst={"url": f"http://127.0.0.1:{port}{BURST_PATH}"})


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
    if args.action in _OF_A_SERVER and args.server is None:
        raise UsageError(
            f"rse-pf local {args.action} needs a server", hint="rse-pf local status shows their names"
        )
    if args.action not in _OF_A_SERVER and args.server is not None:
        hint = "name it with --server" if args.action in _OF_LOGS else "leave the name out"
        raise UsageError(f"rse-pf local {args.action} takes no server", hint=hint)
    if args.action != "start" and args.burst is not None:
        raise UsageError("--burst is for the start of a platform", hint="see rse-pf local --help")
    of_logs = (args.of_server, args.follow, args.since, args.robot, args.tenant)
    if args.action not in _OF_LOGS and any(of_logs):
        raise UsageError(
            "--server, --follow, --since, --robot and --tenant are for logs and events",
            hint="see rse-pf local --help",
        )
    of_start = (args.lan, args.metrics_port, args.record, args.rosbridge or None)
    if args.action != "start" and any(value is not None for value in of_start):
        raise UsageError(
            "--lan, --metrics-port, --record and --rosbridge are for the start of a platform",
            hint="see rse-pf local --help",
        )
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
    if args.action == "robots":
        return _robots(args, state)
    if args.action in ("drain", "roll"):
        return _operate(args, state)
    if args.action == "kill-balancer":
        show(f"killed the load balancer (pid {faults.kill_balancer(state)})")
        return 0
    server = faults.find_server(state, args.server)
    if args.action == "pause" and args.for_s is not None:
        _check_pause(args.for_s, faults.longest_pause_s(state, server, _health(folder)), server.name)
    signal.pthread_sigmask(signal.SIG_BLOCK, _STOPPERS)
    wait = functools.partial(_wait, math.inf if args.for_s is None else time.monotonic() + args.for_s)
    if args.action == "slow":
        show(f"{server.name} has {args.percent:g} % of its time; Ctrl-C ends that")
        faults.slow_down(server.process, args.percent, wait)
        show(f"{server.name} {_describe_outcome(server, 'has all of its time again')}")
    elif args.action == "partition":
        with faults.cut_off(server, args.name):
            show(f"{server.name} is cut off; Ctrl-C ends that")
            wait(math.inf)
        show(f"{server.name} {_describe_outcome(server, 'is reachable again')}")
    else:
        number = {"kill": signal.SIGKILL, "pause": signal.SIGSTOP, "resume": signal.SIGCONT}[args.action]
        count = faults.signal_tree(server.process, number)
        done = {"kill": "killed", "pause": "stopped", "resume": "let go on"}[args.action]
        show(f"{done}: {server.name} (pid {server.process.pid}, {count} processes)")
        if args.action == "pause" and args.for_s is not None:
            wait(math.inf)
            faults.signal_tree(server.process, signal.SIGCONT)
            show(f"{server.name} {_describe_outcome(server, 'goes on')}")
    return 0


def _health(folder: Path) -> HealthSettings:
    from rse_pf.local.state import platform_settings

    return (platform_settings(folder) or PlatformSettings()).health


def _check_pause(for_s: float, longest_s: float, server: str) -> None:
    """Refuse a pause that would never end, because the server is replaced first."""
    if for_s >= longest_s:
        raise UsageError(
            f"{server} would not go on after {for_s:g} s: a server that is stopped is replaced after "
            f"{longest_s:g} s (health.unhealthy_checks)",
            hint=f"pause it for less than {longest_s:g} s, or leave --for out to see it replaced",
        )


def _describe_outcome(server: Any, done: str) -> str:
    """Return what became of a server after a fault: *done*, or that it is gone."""
    from rse_pf.local.processes import is_alive

    return done if is_alive(server.process) else "is gone: it was replaced meanwhile"


def _logs(args: argparse.Namespace, folder: Path) -> int:
    from rse_pf.cli.local_platform import logs

    is_events = args.action == "events"
    wanted = logs.LogFilter(
        level=args.level,
        since_s=-math.inf if args.since is None else logs.since_time_s(args.since, time.time()),
        robot=args.robot,
        tenant=args.tenant,
        process=args.of_server or "",
        events_only=is_events,
    )
    to_text = logs.format_event if is_events else logs.format_line
    to_document = logs.event_document if is_events else logs.line_document

    def show_line(line: logs.LogLine) -> None:
        if args.json:
            show_json(to_document(line))
        else:
            show(to_text(line))

    follower = logs.LogFollower(folder, wanted)
    for line in logs.last_lines(logs.log_files(folder, args.of_server), wanted, _LINES):
        show_line(line)
    if args.follow:
        signal.pthread_sigmask(signal.SIG_BLOCK, _STOPPERS)
        follower.follow(show_line, functools.partial(_wait, math.inf, _FOLLOW_S))
    return 0


def _robots(args: argparse.Namespace, state: Any) -> int:
    from rse_pf.cli.local_platform.robots import connected_robots, robots_table

    robots = connected_robots(state)
    if args.json:
        show_json(robots, indent=2)
    else:
        show(*robots_table(robots))
        for name in robots["silent"]:
            show(f"no answer from {name}", error=True)
    return 1 if robots["silent"] else 0


def _operate(args: argparse.Namespace, state: Any) -> int:
    """Drain a server or replace all; Ctrl-C ends only the report."""
    from rse_pf.cli.local_platform.operations import operate

    parameters = {} if args.server is None else {"server": args.server}
    if args.action == "roll" and args.settings is not None:
        parameters = {"settings": str(args.settings.absolute())}
    try:
        operate(state, args.action, _show, **parameters)
    except KeyboardInterrupt:
        show("the platform goes on with it; rse-pf local status shows how far it is", error=True)
        return 130
    show(f"{args.server} has left" if args.action == "drain" else "every server was replaced")
    return 0


def _wait(end_s: float, seconds: float) -> bool:
    """Wait *seconds*, but not past *end_s* (monotonic) or a signal; return whether one of these came."""
    left_s = min(seconds, max(0.0, end_s - time.monotonic()))
    if math.isinf(left_s):
        signal.sigwait(_STOPPERS)
        return True
    return signal.sigtimedwait(_STOPPERS, left_s) is not None or time.monotonic() >= end_s


class _Extras(NamedTuple):
    """The processes beside a platform: fleet page, burst function (None: none)."""

    page: bool
    burst_port: int | None


async def _foreground(
    name: str, folder: Any, settings: PlatformSettings, *, data: bool, lan: str, extras: _Extras
) -> int:  # fmt: skip
    from rse_pf.cli.local_platform.page import page_beside, process_beside
    from rse_pf.extensions.recording.platform_recorder import make_platform_recorder
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
        lan=lan,
        metrics_port=settings.local.metrics_port,
        recorder=make_platform_recorder(settings, folder),
    )
    try:
        async with platform:
            ready = True
            _show_welcome(platform, name)
            beside = page_beside(folder, settings.local.page_port, _show_page)
            burst = process_beside(
                "lambda_pnp.local_front", folder, extras.burst_port or 0, folder / "burst.log",
                lambda url: show(f"burst function      {url}"),
            )  # fmt: skip
            async with (
                beside if extras.page else nullcontext(),
                burst if extras.burst_port else nullcontext(),
            ):  # fmt: skip
                await stopped.wait()
                show("", "stopping")
    except asyncio.CancelledError:
        show("", "stopped before it was ready", error=True)
        return 130
    return 0


def _show_welcome(platform: Any, name: str) -> None:
    from rse_pf.local.control.status import data_url

    which = "" if name == DEFAULT_NAME else f" --name {name}"
    has_data = platform.data_servers.process.is_running()
    recordings = platform.settings.recording.folder
    rosbridge = platform.url.removesuffix(ROBOTS_PATH) + ROSBRIDGE_PATH
    show(
        "",
        f"robots connect to   {platform.url}",
        *([f"large data goes to  {data_url(platform.url)}"] if has_data else []),
        *([f"rosbridge clients   {rosbridge}"] if platform.settings.serving.rosbridge else []),
        f"a robot's token     rse-pf token issue robot-1{which}",
        *_lan_lines(platform, which),
        f"metrics             {platform.metrics_url}",
        *([f"recordings          {recordings}"] if recordings else []),
        f"to stop             Ctrl-C, or rse-pf local stop{which}",
        f"logs and state      {platform.state}",
        "",
    )


def _show_page(url: str) -> None:
    show(f"fleet page          {url}")


def _lan_lines(platform: Any, which: str) -> list[str]:
    """Return what other machines need; nothing without --lan."""
    from rse_pf.cli.local_platform.lan import lan_lines

    if platform.lan is None:
        return []
    from rse_pf.local.lan.listener import authority_file

    return lan_lines(platform.url, platform.lan.authority(), authority_file(platform.state), which)


def _show(event: Any) -> None:
    from rse_pf.cli.local_platform.logs import local_time
    from rse_pf.extensions.fleet_page.feeds.events import EVENTS, event_sentence

    if event["event"] in EVENTS and event["event"] not in _QUIET:
        show(f"{local_time(time.time())}  {event_sentence(event)}")


_QUIET = frozenset(
    (
        "data-server-start", "platform-gone", "rosbridge-start", "server-healthy", "server-launched",
        "server-out", "standby-started",
    )
)  # fmt: skip
"""Events that the terminal does not show: another event of the same server follows at once."""
