"""Write a service of your own, try it, and run it: in Python, C/C++ or Lua.

new creates a folder with a working service; test replays its recorded requests in a sandbox like those of a
server; run serves it from a local platform until Ctrl-C and loads every saved change; install copies it for
rse-pf local --services; call sends a request to a running local platform.

lock writes the versions and hashes of the Python packages in requirements.in to requirements.txt; build
installs them once, and compiles C and C++; test, run and install build, too.

publish hands a service to all servers on AWS, pinned by its digest; they load it while robots are connected.
publish --list shows what they run, publish NAME --remove takes it out.

A server refuses a service or a request after crashes: to the robot whose sandboxes crashed, and to others if
theirs crashed as well.  status shows what is refused to whom and for how long, unblock lifts it.

examples:
  rse-pf service new centroid --lang lua
  rse-pf service test centroid
  rse-pf service run centroid
  rse-pf service lock centroid
  rse-pf service publish centroid
  rse-pf service publish --list
  rse-pf service status
  rse-pf service unblock centroid --robot robot-1
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import secrets
import shutil
import signal
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.cli.local_platform.logs import LogFollower, LogLine
from rse_pf.cli.services.blocks import ServersRequest, UnblockRequest, show_blocks, unblock
from rse_pf.cli.services.building import FolderRequest, build_service, built_service, changed_s, lock_service
from rse_pf.cli.services.publishing import PublishRequest, publish_service
from rse_pf.cli.services.replaying import Recorded, plain, recorded_requests, replay
from rse_pf.command_line.extras import require
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError, UsageError
from rse_pf.local.state import read_state, state_folder
from rse_pf.services.custom.cpp import INCLUDE_FOLDER
from rse_pf.services.custom.installed import NAME_PATTERN, install, installed_services
from rse_pf.services.custom.output import format_output_line
from rse_pf.storage.files import read_document
from rse_pf.terminal import error_lines, show, show_json, show_progress

__all__ = ["ACTION"]

_LANGUAGES = ("python", "cpp", "lua")
# The text of a line of a server's log that holds a line which the service printed.
_OUTPUT = re.compile(r"service-output robot=(?P<robot>\S+) text=(?P<text>.*) tenant=\S+")
# Time between two checks of run for changed files and printed lines, in seconds.
_POLL_S = 0.3
# Fields of a recorded request; call sends only the field ``request`` of a file that has no others.
_RECORDED_FIELDS = {"request", "reply", "tolerance", "failure"}


@dataclass(frozen=True, kw_only=True)
class _NewRequest:
    name: str = option(metavar="NAME", help="name of the service, and of its folder")
    lang: str = option("--lang", choices=_LANGUAGES, default="python", help="language (default: python)")


@dataclass(frozen=True, kw_only=True)
class _RunRequest(FolderRequest):
    once: bool = option("--once", help="answer the recorded requests, then exit")


@dataclass(frozen=True, kw_only=True)
class _ListRequest:
    services: Path | None = option(
        "--services",
        metavar="DIR",
        help="folder of the installed services (default: services.folder, or that of rse-pf local)",
    )

    def services_folder(self, settings: PlatformSettings) -> Path:
        """Return the folder of installed services: --services, else the setting, else the local default."""
        if self.services is not None:
            return self.services
        if settings.services.folder:
            return Path(settings.services.folder)
        return state_folder("default", os.environ).parent / "services"


@dataclass(frozen=True, kw_only=True)
class _InstallRequest(FolderRequest, _ListRequest):
    pass


@dataclass(frozen=True, kw_only=True)
class _CallRequest:
    service: str = option(metavar="NAME", help="name of the service")
    request: str = option(
        "--request",
        default="{}",
        metavar="JSON|FILE",
        help="the request as JSON; @FILE reads it from a file, which may be a recorded request",
    )
    name: str = option("--name", default="default", help="name of the local platform (default: %(default)s)")


# --- the actions new, install, list and test ------------------------------------------------------


def create(request: _NewRequest, settings: PlatformSettings) -> None:
    """Create a folder in the working folder with the template of a service, which works as it is.

    Raises:
        UsageError: The name is not valid, or the folder exists.
    """
    name, language = request.name, request.lang
    if not NAME_PATTERN.fullmatch(name):
        raise UsageError(
            f"{name[:60]!r} is not a valid service name",
            hint="use 1 to 40 lower-case letters, digits, - and _",
        )
    folder = Path.cwd() / name
    if folder.exists():
        raise UsageError(f"{folder} exists already", hint="choose another name, or remove it")
    template = INCLUDE_FOLDER.parent / "templates" / language
    (folder / "requests").mkdir(parents=True)
    for path in sorted(path for path in template.iterdir() if path.is_file() and path.suffix != ".pyc"):
        text = path.read_text(encoding="utf-8").replace("@NAME@", name)
        target = folder / "requests" / path.name if path.name == "example.json" else folder / path.name
        target.write_text(text, encoding="utf-8")
    if language == "cpp":
        shutil.copytree(INCLUDE_FOLDER, folder / "include")
    show(
        f"{folder} is a working service",
        "",
        f"  rse-pf service test {name}     replay its recorded request",
        f"  rse-pf service run {name}      serve it, and load every saved change",
    )


def install_service(request: _InstallRequest, settings: PlatformSettings) -> None:
    """Build a service, and copy it into the folder of installed services."""
    folder = request.services_folder(settings)
    built, dependencies = built_service(request.folder)
    service = install(built.folder, folder, dependencies)
    show(
        f"{service.name} ({service.language}) is installed in {folder}",
        f"serve it with: rse-pf local --services {folder}",
    )


def list_services(request: _ListRequest, settings: PlatformSettings) -> None:
    """Print name, language, kind, digest and folder of each installed service."""
    for service in installed_services(request.services_folder(settings)):
        about = f"{service.name:<24} {service.language:<8} {service.kind:<18} {service.identity[:12]}"
        show(f"{about}  {service.folder}")


def test(request: FolderRequest, settings: PlatformSettings) -> int:
    """Replay the recorded requests of a service in a sandbox; return 1 if an answer is wrong."""
    return replay(built_service(request.folder)[0], recorded_requests(request.folder), settings)


# --- the actions run and call ---------------------------------------------------------------------


def run(request: _RunRequest, settings: PlatformSettings) -> int:
    """Serve a service from a platform in a temporary folder until Ctrl-C, and load every saved change.

    The recorded requests are sent first; with --once the platform stops after them.  Returns 1 if, with
    --once, a request failed unexpectedly, else 0.
    """
    require("service")
    return asyncio.run(_run(request.folder, settings, once=request.once))


def call(request: _CallRequest, settings: PlatformSettings) -> None:
    """Send a request to a service of a running local platform, and print the reply as JSON."""
    show_json(plain(asyncio.run(_call(request.service, request.request, request.name, settings))))


async def _run(source: Path, settings: PlatformSettings, *, once: bool) -> int:
    from rse_pf.local.control.platform import LocalPlatform

    service, dependencies = built_service(source)
    recorded = recorded_requests(source)
    with tempfile.TemporaryDirectory(prefix="rse-pf-service-") as temporary:
        place = Path(temporary)
        install(service.folder, place / "services", dependencies)
        chosen = settings.replace(services={"folder": str(place / "services"), "accept_weak_isolation": True})
        output = LogFollower(place / "platform")
        stopped = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, stopped.set)
        show_progress("starting a platform ...", is_over=False)
        try:
            async with LocalPlatform(
                chosen, state=place / "platform", servers=1, port=0, name="service"
            ) as platform:
                show_progress("", is_over=False)
                show(f"{service.name} is served at {platform.url}")
                good = await _ask_recorded(platform, service, recorded, settings)
                if once:
                    return 0 if good else 1
                show(f"save a file in {source} to load it again; Ctrl-C ends")
                changed_at_s = changed_s(service.folder)
                while not stopped.is_set():
                    _show_output(output)
                    try:
                        await asyncio.wait_for(stopped.wait(), _POLL_S)
                    except asyncio.TimeoutError:
                        newest = changed_s(service.folder)
                        if newest > changed_at_s:
                            changed_at_s = newest
                            await _reload(platform, source, place / "services", recorded, settings)
        finally:
            _show_output(output)  # lines that the service printed until its server stopped
    return 0


def _show_output(output: LogFollower) -> None:
    """Print the lines that the service has printed since the last call."""
    for line in output.new_lines():
        line_text = _format_line(line)
        if line_text:
            show(line_text)


def _format_line(line: LogLine) -> str:
    """Return *line* for the terminal if it holds a line that the service printed, else ""."""
    printed = _OUTPUT.fullmatch(line.text)
    if printed is None:
        return ""
    text = printed["text"]
    with suppress(ValueError):  # a text with spaces is quoted
        text = str(json.loads(text)) if text.startswith('"') else text
    return format_output_line(line.time_s, printed["robot"], text)


async def _reload(
    platform: Any, source: Path, services: Path, recorded: Recorded, settings: PlatformSettings
) -> None:
    try:
        built, dependencies = built_service(source)
        service = install(built.folder, services, dependencies)
        await platform.roll()
        await _ask_recorded(platform, service, recorded, settings)
    except RsePfError as error:  # shown only, so that the author can correct the source and save again
        show(*error_lines(error))


async def _ask_recorded(platform: Any, service: Any, recorded: Recorded, settings: PlatformSettings) -> bool:
    """Send every recorded request as a robot, and print the answers; return whether none failed unexpectedly.

    Replies are not compared.  Robots do not get the reason of a failure: to show it to the author, the first
    request that failed unexpectedly is repeated in a dry run, a sandbox without a server.
    """
    from client_sdk import connect
    from rse_pf.server.sandbox.dry_run import dry_run

    failed = []
    async with connect(platform.url, token=platform.issue_token("robot-1")) as robot:
        for path, call in recorded:
            try:
                answer = await robot.call(service.name, call["request"])
            except RsePfError as error:
                if call.get("failure") != error.code:
                    failed.append(call["request"])
                hint = f" ({error.hint})" if error.hint else ""
                show(f"{path}: {error.code}: {error.message}{hint}")
                continue
            reply_text = json.dumps(plain(answer.reply))
            show(f"{path}: {reply_text[:500]}  ({answer.round_trip_ms:.1f} ms)")
    if failed:
        await asyncio.to_thread(dry_run, service, failed[:1], settings, lambda line: show(f"  {line}"))
    return not failed


async def _call(name: str, request: str, platform: str, settings: PlatformSettings) -> Any:
    from client_sdk import connect
    from rse_pf.local.firewall import key_file, read_key

    payload, folder = _payload(request), state_folder(platform, os.environ)
    state = read_state(folder)
    if state is None or not state.url:
        raise UsageError(f"no platform named {platform!r} is running", hint="start one with: rse-pf local")
    token = read_key(key_file(folder)).issue(
        "command-line", now=time.time(), token_id=secrets.token_hex(8), settings=settings.auth
    )
    async with connect(state.url, token=token) as robot:
        answer = await robot.call(name, payload)
    return answer.reply


def _payload(text: str) -> Any:
    """Return the request in *text*, JSON or ``@FILE``; of a recorded request its field ``request``.

    Raises:
        UsageError: The text or the file is not JSON.
    """
    hint = "write --request '{\"points\": [0, 0, 1]}'"
    if text.startswith("@"):
        payload = read_document(Path(text[1:]), "JSON", hint=hint)
    else:
        try:
            payload = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise UsageError(f"--request is not JSON: {error}", hint=hint) from error
    if isinstance(payload, dict) and "request" in payload and set(payload) <= _RECORDED_FIELDS:
        return payload["request"]
    return payload


ACTION = Action(
    actions={
        "new": Action(
            help="create the folder of a service that works",
            example="rse-pf service new centroid --lang lua",
            request=_NewRequest,
            run=create,
        ),
        "test": Action(
            help="replay the recorded requests of a service in a sandbox",
            example="rse-pf service test centroid",
            request=FolderRequest,
            run=test,
        ),
        "run": Action(
            help="serve a service from a local platform until Ctrl-C, and load every saved change",
            example="rse-pf service run centroid",
            request=_RunRequest,
            run=run,
        ),
        "lock": Action(
            help="write versions and hashes of the service's Python packages to requirements.txt",
            example="rse-pf service lock centroid",
            request=FolderRequest,
            run=lock_service,
        ),
        "build": Action(
            help="install the Python packages of a service, or compile C and C++",
            example="rse-pf service build centroid",
            request=FolderRequest,
            run=build_service,
        ),
        "install": Action(
            help="copy a service to the installed ones, for rse-pf local --services",
            example="rse-pf service install centroid",
            request=_InstallRequest,
            run=install_service,
        ),
        "list": Action(
            help="show the installed services",
            example="rse-pf service list",
            request=_ListRequest,
            run=list_services,
        ),
        "call": Action(
            help="send a request to a service of a running local platform",
            example="rse-pf service call centroid --request @requests/example.json",
            request=_CallRequest,
            run=call,
        ),
        "status": Action(
            help="show which services and requests are refused to whom after crashes",
            example="rse-pf service status",
            request=ServersRequest,
            run=show_blocks,
        ),
        "unblock": Action(
            help="accept again what is refused after crashes",
            example="rse-pf service unblock centroid --robot robot-1",
            request=UnblockRequest,
            run=unblock,
        ),
        "publish": Action(
            help="publish a service to all servers on AWS, list them, or remove one",
            example="rse-pf service publish centroid",
            request=PublishRequest,
            run=publish_service,
        ),
    },
)
