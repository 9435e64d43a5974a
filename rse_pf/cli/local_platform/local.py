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

import asyncio
import functools
import math
import os
import signal
import time
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rse_pf.cli.local_platform.logs import (
    LogFilter,
    LogFollower,
    LogLine,
    event_document,
    format_event,
    format_line,
    last_lines,
    line_document,
    local_time,
    log_files,
    since_time_s,
)
from rse_pf.command_line.extras import is_installed, require
from rse_pf.command_line.options import Action, option
from rse_pf.config import HealthSettings, PlatformSettings
from rse_pf.config.resource_names import ROBOTS_PATH, ROSBRIDGE_PATH
from rse_pf.errors import UsageError
from rse_pf.terminal import show, show_json, show_page

if TYPE_CHECKING:
    from rse_pf.local.control.platform_recorder import PlatformRecorder
    from rse_pf.local.state import PlatformState

__all__ = ["ACTION", "DEFAULT_NAME", "PlatformRequest"]

# Name of the platform if --name is not given.
DEFAULT_NAME = "default"
# Port on loopback of the burst function if --burst is given without a port.
_BURST_PORT = 8702
# Number of the newest lines that logs and events print without --since.
_LINES = 100
# Time between two readings of the logs with --follow, in seconds.
_FOLLOW_S = 0.2
# Time over which status measures CPU load and requests/s, in seconds.
_SAMPLE_S = 0.5
# Signals that end a fault, --follow, or the platform.
_STOPPERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Defaults of the settings group local, for the help page.
_DEFAULTS = PlatformSettings().local


@dataclass(frozen=True, kw_only=True)
class PlatformRequest:
    """The option that names a platform on this machine."""

    name: str = option(
        "--name", default=DEFAULT_NAME, help=f"name of the platform, if several run (default: {DEFAULT_NAME})"
    )

    @property
    def folder(self) -> Path:
        """State folder of the platform, which need not exist; raises UsageError for an invalid name."""
        from rse_pf.local.state import state_folder

        return state_folder(self.name, os.environ)

    def read_state(self) -> PlatformState:
        """Return the content of the platform's state file; raises UsageError if it does not run."""
        from rse_pf.local.state import read_state

        state = read_state(self.folder)
        if state is None:
            raise UsageError(f"platform {self.name!r} is not running", hint="start it with: rse-pf local")
        return state


@dataclass(frozen=True, kw_only=True)
class _StartRequest(PlatformRequest):
    servers: int | None = option(
        "--servers",
        metavar="N",
        help=f"backend servers at the start (local.servers, default {_DEFAULTS.servers})",
    )
    port: int | None = option(
        "--port",
        metavar="P",
        help=f"port that robots connect to; 0 takes a free one (local.port, default {_DEFAULTS.port})",
    )
    lan: str | None = option(
        "--lan",
        nargs="?",
        const="",
        metavar="ADDRESS",
        help="listen on ADDRESS of this machine (default: a detected one) with TLS, for other machines",
    )
    metrics_port: int | None = option(
        "--metrics-port",
        metavar="P",
        help="port on loopback of the metrics of all servers; 0 takes a free one (local.metrics_port, "
        f"default {_DEFAULTS.metrics_port})",
    )
    no_page: bool = option("--no-page", help="do not start the fleet page")
    burst: int | None = option(
        "--burst",
        nargs="?",
        const=0,
        metavar="P",
        help=f"also run the burst function, at port P on loopback (default {_BURST_PORT}): robots call it "
        "while no server answers in time",
    )
    rosbridge: bool = option(
        "--rosbridge",
        help="also serve rosbridge v2 clients, on the path /rosbridge (serving.rosbridge)",
    )
    no_data: bool = option(
        "--no-data", help="do not start the data service (large data by HTTP under /data/)"
    )
    record: Path | None = option(
        "--record",
        metavar="DIR",
        help="record the messages of robots and servers in DIR, for rse-pf replay (recording.folder)",
    )
    services: str | None = option(
        "--services", metavar="DIR", help="also run the services installed there (rse-pf service install)"
    )
    accept_weak_isolation: bool = option(
        "--accept-weak-isolation", help="run services even if the kernel lacks a kind of isolation"
    )


@dataclass(frozen=True, kw_only=True)
class _StatusRequest(PlatformRequest):
    json: bool = option("--json", help="print JSON")


@dataclass(frozen=True, kw_only=True)
class _LogsRequest(PlatformRequest):
    json: bool = option("--json", help="print one JSON object for each line")
    process: str | None = option(
        "--server", metavar="ID", help="show only lines of this process, or about it"
    )
    follow: bool = option("--follow", help="continue with new lines until Ctrl-C")
    since: str | None = option(
        "--since",
        metavar="TIME",
        help='all lines of the last 90s, 5m, 2h or 1d, or since "2026-03-01 14:30"',
    )
    robot: str = option("--robot", default="", metavar="NAME", help="show only lines about this robot")
    tenant: str = option("--tenant", default="", metavar="NAME", help="show only lines about this tenant")
    level: str = option(
        "--level",
        choices=("debug", "info", "warning", "error"),
        default="debug",
        help="show only lines of at least this level (default: all)",
    )


@dataclass(frozen=True, kw_only=True)
class _ServerRequest(PlatformRequest):
    server: str = option(metavar="SERVER", help="a server, as rse-pf local status lists it")


@dataclass(frozen=True, kw_only=True)
class _RollRequest(PlatformRequest):
    settings: Path | None = None


@dataclass(frozen=True, kw_only=True)
class _FaultRequest(_ServerRequest):
    for_s: float | None = option(
        "--for", metavar="S", help="end the fault after S seconds (default: with Ctrl-C)"
    )

    def __post_init__(self) -> None:
        if self.for_s is not None and not self.for_s > 0:
            raise UsageError("--for takes a positive number of seconds", hint="leave it out")

    def waiter(self) -> Callable[[float], bool]:
        """Block the signals that end a fault, and return a function that waits for them or --for.

        The function takes seconds to wait, and returns whether the fault is to end now.  The time of --for
        begins with this call.
        """
        signal.pthread_sigmask(signal.SIG_BLOCK, _STOPPERS)
        end_s = math.inf if self.for_s is None else time.monotonic() + self.for_s
        return functools.partial(_wait, end_s)


@dataclass(frozen=True, kw_only=True)
class _SlowRequest(_FaultRequest):
    percent: float = option(
        "--percent", required=True, metavar="P", help="leave the server P %% of its CPU time"
    )


def start(request: _StartRequest, settings: PlatformSettings) -> int:
    """Run a platform until a signal or rse-pf local stop; return 0, or 130 if it was not ready before."""
    folder = request.folder
    require("local")
    from rse_pf.cli.local_platform.lan import chosen_address

    overrides = {"servers": request.servers, "port": request.port, "metrics_port": request.metrics_port}
    chosen = settings.replace(local={name: value for name, value in overrides.items() if value is not None})
    chosen = _with_services(chosen, request.services, request.accept_weak_isolation)
    if request.record is not None or chosen.recording.folder:
        from rse_pf.extensions.recording.writer import with_recordings

        chosen = with_recordings(chosen, request.record)
    if request.rosbridge:
        chosen = chosen.replace(serving={"rosbridge": True})
    lan = chosen_address(request.lan)
    burst_port = None if request.burst is None else request.burst or _BURST_PORT
    if burst_port is not None:
        chosen = _with_burst(chosen, burst_port, lan)
    has_page = not request.no_page and is_installed("rse_pf.extensions.fleet_page")
    return asyncio.run(
        _foreground(
            request.name, folder, chosen, data=not request.no_data, lan=lan,
            extras=_Extras(page=has_page, burst_port=burst_port),
        )
    )  # fmt: skip


def stop(request: PlatformRequest, settings: PlatformSettings) -> None:
    """Stop all processes of a platform, if it runs."""
    from rse_pf.local.state import stop_platform

    stopped = stop_platform(request.folder)
    show(f"platform {request.name!r} {'is stopped' if stopped else 'was not running'}")


def _with_burst(settings: PlatformSettings, port: int, lan: str) -> PlatformSettings:
    """Return *settings* with the address, at *port* on loopback, of the burst function.

    Servers announce that address to robots, which call the function while no server answers in time.

    Raises:
        UsageError: *lan* is not empty, or *port* is no port.
        ConfigurationError: Another program listens on *port*.
    """
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


def _with_services(
    settings: PlatformSettings, services: str | None, is_weak_accepted: bool
) -> PlatformSettings:
    """Return *settings* with the folder *services* of installed services, and weak isolation if accepted.

    Raises:
        UsageError: A service in the folder is damaged.
    """
    changes: dict[str, Any] = {"accept_weak_isolation": True} if is_weak_accepted else {}
    if services is not None:
        from rse_pf.services.custom.installed import installed_services

        folder = Path(services).absolute()
        installed_services(folder)
        changes["folder"] = str(folder)
    return settings.replace(services=changes)


def show_status(request: _StatusRequest, settings: PlatformSettings) -> None:
    """Print processes, load and disk warnings of a platform that runs, as a table or as JSON."""
    from rse_pf.local.control.status import platform_status, status_table

    status = asyncio.run(platform_status(request.read_state(), sample_s=_SAMPLE_S))
    if request.json:
        show_json(status, indent=2)
    else:
        show_page(status_table(status))


def kill_balancer(request: PlatformRequest, settings: PlatformSettings) -> None:
    """Kill the load balancer of a platform; its control plane starts another one."""
    from rse_pf.local import faults

    show(f"killed the load balancer (pid {faults.kill_balancer(request.read_state())})")


def kill(request: _ServerRequest, settings: PlatformSettings) -> None:
    """Send SIGKILL to all processes of a server."""
    _signal(request, signal.SIGKILL, "killed")


def resume(request: _ServerRequest, settings: PlatformSettings) -> None:
    """Send SIGCONT to all processes of a server that was paused."""
    _signal(request, signal.SIGCONT, "continued")


def pause(request: _FaultRequest, settings: PlatformSettings) -> None:
    """Send SIGSTOP to all processes of a server, and with --for continue them after that time or Ctrl-C."""
    from rse_pf.local import faults

    state = request.read_state()
    server = faults.find_server(state, request.server)
    if request.for_s is not None:
        longest_s = faults.longest_pause_s(state, server, _health(request.folder))
        _check_pause(request.for_s, longest_s, server.name)
    wait = request.waiter()
    _signal(request, signal.SIGSTOP, "stopped")
    if request.for_s is not None:
        wait(math.inf)
        faults.signal_tree(server.process, signal.SIGCONT)
        show(f"{server.name} {_describe_outcome(server, 'continues')}")


def slow(request: _SlowRequest, settings: PlatformSettings) -> None:
    """Slow a server down to --percent of its CPU time, until the time of --for is over or Ctrl-C."""
    from rse_pf.local import faults

    server = faults.find_server(request.read_state(), request.server)
    wait = request.waiter()
    show(f"{server.name} has {request.percent:g} % of its time; Ctrl-C ends that")
    faults.slow_down(server.process, request.percent, wait)
    show(f"{server.name} {_describe_outcome(server, 'has all of its time again')}")


def partition(request: _FaultRequest, settings: PlatformSettings) -> None:
    """Cut a server off from the network, until the time of --for is over or Ctrl-C."""
    from rse_pf.local import faults

    server = faults.find_server(request.read_state(), request.server)
    wait = request.waiter()
    with faults.cut_off(server, request.name):
        show(f"{server.name} is cut off; Ctrl-C ends that")
        wait(math.inf)
    show(f"{server.name} {_describe_outcome(server, 'is reachable again')}")


def _signal(request: _ServerRequest, number: signal.Signals, done: str) -> None:
    """Send signal *number* to all processes of the server; print *done* and how many processes these are."""
    from rse_pf.local import faults

    server = faults.find_server(request.read_state(), request.server)
    count = faults.signal_tree(server.process, number)
    show(f"{done}: {server.name} (pid {server.process.pid}, {count} processes)")


def _health(folder: Path) -> HealthSettings:
    """Return the health settings of the platform in *folder*, the defaults if it has no settings file."""
    from rse_pf.local.state import platform_settings

    return (platform_settings(folder) or PlatformSettings()).health


def _check_pause(for_s: float, longest_s: float, server: str) -> None:
    """Raise UsageError if a pause of *for_s* is too long: the server is replaced after *longest_s*."""
    if for_s >= longest_s:
        raise UsageError(
            f"{server} would not go on after {for_s:g} s: a server that is stopped is replaced after "
            f"{longest_s:g} s (health.unhealthy_checks)",
            hint=f"pause it for less than {longest_s:g} s, or leave --for out to see it replaced",
        )


def _describe_outcome(server: Any, done: str) -> str:
    """Return the words for the state of a server after a fault: *done*, or that it was replaced."""
    from rse_pf.local.processes import is_alive

    return done if is_alive(server.process) else "is gone: it was replaced meanwhile"


def show_logs(request: _LogsRequest, settings: PlatformSettings) -> None:
    """Print the newest lines of the logs of all processes, and with --follow each new line."""
    _show_lines(request, format_line, line_document)


def show_events(request: _LogsRequest, settings: PlatformSettings) -> None:
    """Print the newest events of servers, robots and live maps, and with --follow each new one."""
    _show_lines(request, format_event, event_document)


def _show_lines(
    request: _LogsRequest, to_text: Callable[[LogLine], str], to_document: Callable[[LogLine], Any]
) -> None:
    wanted = LogFilter(
        level=request.level,
        since_s=-math.inf if request.since is None else since_time_s(request.since, time.time()),
        robot=request.robot,
        tenant=request.tenant,
        process=request.process or "",
        events_only=to_text is format_event,
    )

    def show_line(line: LogLine) -> None:
        if request.json:
            show_json(to_document(line))
        else:
            show(to_text(line))

    follower = LogFollower(request.folder, wanted)
    for line in last_lines(log_files(request.folder, request.process), wanted, _LINES):
        show_line(line)
    if request.follow:
        signal.pthread_sigmask(signal.SIG_BLOCK, _STOPPERS)
        follower.follow(show_line, functools.partial(_wait, math.inf, _FOLLOW_S))


def show_robots(request: _StatusRequest, settings: PlatformSettings) -> int:
    """Print the robots that are connected; return 1 if a server did not answer, else 0."""
    from rse_pf.cli.local_platform.robots import connected_robots, robots_table

    robots = connected_robots(request.read_state())
    if request.json:
        show_json(robots, indent=2)
    else:
        show(*robots_table(robots))
        for name in robots["silent"]:
            show(f"no answer from {name}", error=True)
    return 1 if robots["silent"] else 0


def drain(request: _ServerRequest, settings: PlatformSettings) -> int:
    """Move the robots of a server to other servers, wait until it has exited, and return the exit code."""
    return _operate(request, "drain", {"server": request.server}, f"{request.server} has left")


def roll(request: _RollRequest, settings: PlatformSettings) -> int:
    """Replace all servers one by one, with the settings of --settings if given; return the exit code."""
    file = request.settings
    parameters = {} if file is None else {"settings": str(file.absolute())}
    return _operate(request, "roll", parameters, "every server was replaced")


def _operate(request: PlatformRequest, action: str, parameters: dict[str, str], done: str) -> int:
    """Have the control plane carry out *action*, print its events, then *done*, and return 0.

    Ctrl-C ends only the output, with exit code 130: the operation goes on.
    """
    from rse_pf.cli.local_platform.operations import operate

    try:
        operate(request.read_state(), action, _show, **parameters)
    except KeyboardInterrupt:
        show("the platform continues; rse-pf local status shows its progress", error=True)
        return 130
    show(done)
    return 0


def _wait(end_s: float, seconds: float) -> bool:
    """Wait *seconds*, but not past *end_s* (monotonic) or a signal of `_STOPPERS`, which must be blocked.

    Returns True if *end_s* has passed or a signal came, else False.
    """
    left_s = min(seconds, max(0.0, end_s - time.monotonic()))
    if math.isinf(left_s):
        signal.sigwait(_STOPPERS)
        return True
    return signal.sigtimedwait(_STOPPERS, left_s) is not None or time.monotonic() >= end_s


class _Extras(NamedTuple):
    """The optional processes of a platform: ``page`` is whether the fleet page runs.

    ``burst_port`` is the port of the burst function; None if that does not run.
    """

    page: bool
    burst_port: int | None


async def _foreground(
    name: str, folder: Any, settings: PlatformSettings, *, data: bool, lan: str, extras: _Extras
) -> int:  # fmt: skip
    """Run the platform *name* in *folder* until a signal, then stop it; return the exit code."""
    from rse_pf.local.control.control_plane import ControlOptions
    from rse_pf.local.control.platform import LocalPlatform
    from rse_pf.local.side_process import run_beside_platform

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
        recorder=_recorder(settings, folder),
    )
    try:
        async with platform:
            ready = True
            _show_welcome(platform, name)
            burst = run_beside_platform(
                "lambda_pnp.local_front", folder, extras.burst_port or 0, folder / "burst.log",
                lambda url: show(f"burst function      {url}"),
            )  # fmt: skip
            async with (
                _page(folder, settings.local.page_port) if extras.page else nullcontext(),
                burst if extras.burst_port else nullcontext(),
            ):  # fmt: skip
                await stopped.wait()
                show("", "stopping")
    except asyncio.CancelledError:
        show("", "stopped before it was ready", error=True)
        return 130
    return 0


def _recorder(settings: PlatformSettings, folder: Path) -> PlatformRecorder | None:
    """Return the recorder of the platform in *folder*; None if ``recording.folder`` is empty."""
    if not settings.recording.folder:
        return None
    from rse_pf.extensions.recording.platform_recorder import FilePlatformRecorder

    return FilePlatformRecorder(settings, folder)


def _page(folder: Path, port: int) -> AbstractAsyncContextManager[None]:
    from rse_pf.extensions.fleet_page.page_process import run_page

    return run_page(folder, port, _show_page)


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
    """Return the lines about connections of other machines; none without --lan."""
    from rse_pf.cli.local_platform.lan import lan_lines

    if platform.lan is None:
        return []
    from rse_pf.local.lan.listener import authority_file

    return lan_lines(platform.url, platform.lan.authority(), authority_file(platform.state), which)


def _show(event: Any) -> None:
    """Print *event* as a sentence with its time, unless it is in `_QUIET` or has no sentence."""
    from rse_pf.local.events import EVENTS, event_sentence

    if event["event"] in EVENTS and event["event"] not in _QUIET:
        show(f"{local_time(time.time())}  {event_sentence(event)}")


_QUIET = frozenset(
    (
        "data-server-start", "platform-gone", "rosbridge-start", "server-healthy", "server-launched",
        "server-out", "standby-started",
    )
)  # fmt: skip
"""Events that the terminal does not show.  Other lines of the terminal say nearly the same, for instance
``server-ready`` for ``server-launched``, and ``drain-start`` or ``server-gone`` for ``server-out``."""

ACTION = Action(
    default="start",
    actions={
        "start": Action(
            help="run a platform until Ctrl-C (default)",
            example="rse-pf local --servers 2",
            request=_StartRequest,
            run=start,
        ),
        "stop": Action(
            help="stop a platform", example="rse-pf local stop", request=PlatformRequest, run=stop
        ),
        "status": Action(
            help="show servers, alarms and load",
            example="rse-pf local status",
            request=_StatusRequest,
            run=show_status,
        ),
        "robots": Action(
            help="show the robots that are connected",
            example="rse-pf local robots",
            request=_StatusRequest,
            run=show_robots,
        ),
        "logs": Action(
            help="show the logs of all processes",
            example="rse-pf local logs --since 5m --level warning",
            request=_LogsRequest,
            run=show_logs,
        ),
        "events": Action(
            help="show what happened to servers, robots and live maps",
            example="rse-pf local events --follow --json",
            request=_LogsRequest,
            run=show_events,
        ),
        "drain": Action(
            help="move the robots of a server to other servers, and close it",
            example="rse-pf local drain server-1",
            request=_ServerRequest,
            run=drain,
        ),
        "roll": Action(
            help="replace all servers without loss",
            example="rse-pf local roll --settings settings.json",
            request=_RollRequest,
            run=roll,
        ),
        "kill": Action(
            help="inject a fault: kill all processes of a server",
            example="rse-pf local kill server-1",
            request=_ServerRequest,
            run=kill,
        ),
        "pause": Action(
            help="inject a fault: stop all processes of a server",
            example="rse-pf local pause server-1 --for 0.3",
            request=_FaultRequest,
            run=pause,
        ),
        "resume": Action(
            help="continue a server that was paused",
            example="rse-pf local resume server-1",
            request=_ServerRequest,
            run=resume,
        ),
        "slow": Action(
            help="inject a fault: leave a server a part of its CPU time",
            example="rse-pf local slow server-2 --percent 10 --for 30",
            request=_SlowRequest,
            run=slow,
        ),
        "partition": Action(
            help="inject a fault: cut a server off from the network",
            example="rse-pf local partition server-1 --for 5",
            request=_FaultRequest,
            run=partition,
        ),
        "kill-balancer": Action(
            help="inject a fault: kill the load balancer",
            example="rse-pf local kill-balancer",
            request=PlatformRequest,
            run=kill_balancer,
        ),
    },
)
