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

import argparse
import asyncio
import json
import os
import re
import secrets
import shutil
import signal
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from rse_pf.cli.local_platform.logs import LogFollower, LogLine
from rse_pf.cli.services.blocks import add_block_arguments, show_blocks, unblock
from rse_pf.cli.services.building import build_service, built_service, changed_s, lock_service
from rse_pf.cli.services.publishing import add_publish_arguments, publish_service
from rse_pf.cli.services.replaying import Recorded, plain, recorded_requests, replay
from rse_pf.command_line.extras import require
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError, UsageError
from rse_pf.local.state import read_state, state_folder
from rse_pf.services.custom.cpp import INCLUDE_FOLDER
from rse_pf.services.custom.installed import NAME_PATTERN, install, installed_services
from rse_pf.services.custom.output import format_output_line
from rse_pf.storage.files import read_document
from rse_pf.terminal import error_lines, show, show_json, show_progress

__all__ = ["add_arguments", "run"]

_ACTIONS = (
    "new", "test", "run", "lock", "build", "install", "list", "call", "status", "unblock", "publish",
)  # fmt: skip
_OF_A_NAME = ("new", "call")
_LANGUAGES = ("python", "cpp", "lua")
_OUTPUT = re.compile(r"service-output robot=(?P<robot>\S+) text=(?P<text>.*) tenant=\S+")
_POLL_S = 0.3
_RECORDED_FIELDS = {"request", "reply", "tolerance", "failure"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("action", choices=_ACTIONS, help="what to do")
    parser.add_argument(
        "what", nargs="?", metavar="NAME|FOLDER",
        help="new, call: a name; test, run, lock, build, install, publish: the folder; "
        "unblock: only this service; publish --remove: the name",
    )  # fmt: skip
    parser.add_argument(
        "--lang", choices=_LANGUAGES, default="python", help="new: language (default: python)"
    )
    parser.add_argument("--services", type=Path, metavar="DIR", help="install, list: the services folder")
    parser.add_argument(
        "--request", metavar="JSON|FILE",
        help="call: the request as JSON; @FILE reads it from a file, which may be a recorded request",
    )  # fmt: skip
    parser.add_argument(
        "--name", default="default",
        help="call, status, unblock: name of the local platform (default: default)",
    )  # fmt: skip
    add_block_arguments(parser)
    add_publish_arguments(parser)
    parser.add_argument("--once", action="store_true", help="run: answer the recorded requests, then end")


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Do one of the actions."""
    without_what: dict[str, Callable[[], int]] = {
        "list": lambda: _list(args.services or _services_folder(settings)),
        "status": lambda: show_blocks(args),
        "unblock": lambda: unblock(args),
        "publish": lambda: publish_service(args, settings),
    }
    if args.action in without_what:
        return without_what[args.action]()
    if args.what is None:
        what = "name" if args.action in _OF_A_NAME else "folder"
        raise UsageError(
            f"rse-pf service {args.action} needs the {what} of a service",
            hint=f"write rse-pf service {args.action} {what.upper()}",
        )
    source = Path(args.what)
    actions: dict[str, Callable[[], int]] = {
        "new": lambda: _new(args.what, args.lang, Path.cwd()),
        "call": lambda: asyncio.run(_call(args.what, args.request, args.name, settings)),
        "install": lambda: _install(source, args.services or _services_folder(settings)),
        "lock": lambda: lock_service(source),
        "build": lambda: build_service(source),
        "test": lambda: replay(built_service(source)[0], recorded_requests(source), settings),
        "run": lambda: asyncio.run(_run(source, settings, once=args.once)),
    }
    if args.action == "run":
        require("service")
    return actions[args.action]()


# --- new, install, list ---------------------------------------------------------------------------


def _new(name: str, language: str, where: Path) -> int:
    if not NAME_PATTERN.fullmatch(name):
        raise UsageError(
            f"{name[:60]!r} is not a valid service name",
            hint="use 1 to 40 lower-case letters, digits, - and _",
        )
    folder = where / name
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
    return 0


def _install(source: Path, folder: Path) -> int:
    built, dependencies = built_service(source)
    service = install(built.folder, folder, dependencies)
    show(
        f"{service.name} ({service.language}) is installed in {folder}",
        f"serve it with: rse-pf local --services {folder}",
    )
    return 0


def _list(folder: Path) -> int:
    for service in installed_services(folder):
        about = f"{service.name:<24} {service.language:<8} {service.kind:<18} {service.identity[:12]}"
        show(f"{about}  {service.folder}")
    return 0


def _services_folder(settings: PlatformSettings) -> Path:
    if settings.services.folder:
        return Path(settings.services.folder)
    return state_folder("default", os.environ).parent / "services"


# --- run, call --------------------------------------------------------------------------------------


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
                show(f"save a file in {source} to load it anew; Ctrl-C ends")
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
            _show_output(output)  # what the servers wrote until they ended
    return 0


def _show_output(output: LogFollower) -> None:
    """Show what the service has printed since the last call."""
    for line in output.new_lines():
        line_text = _format_line(line)
        if line_text:
            show(line_text)


def _format_line(line: LogLine) -> str:
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
    except RsePfError as error:  # the author corrects it and saves again
        show(*error_lines(error))


async def _ask_recorded(platform: Any, service: Any, recorded: Recorded, settings: PlatformSettings) -> bool:
    """Send every recorded request as a robot; return whether all were answered as expected.

    Robots do not get the reason of a failure.  To show it to the author, the first failed request is repeated
    in a dry run.
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


async def _call(name: str, request: str | None, platform: str, settings: PlatformSettings) -> int:
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
    show_json(plain(answer.reply))
    return 0


def _payload(request: str | None) -> Any:
    text = request or "{}"
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
