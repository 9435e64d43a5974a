"""Write a service of your own, try it, and run it: in Python, C/C++ or Lua.

new creates a folder with a working service; test replays its recorded requests in a sandbox like those of a
server; run serves it from a local platform until Ctrl-C and loads every saved change; install copies it for
rse-pf local --services; call sends a request to a running local platform.

A server refuses a service or a request after crashes: to the robot whose sandboxes crashed, and to others if
theirs crashed as well.  status shows what is refused to whom and for how long, unblock lifts it.

examples:
  rse-pf service new centroid --lang lua
  rse-pf service test centroid
  rse-pf service run centroid
  rse-pf service status
  rse-pf service unblock centroid --robot robot-1
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import os
import re
import secrets
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rse_pf.cli.extras import require
from rse_pf.cli.service_blocks import add_block_arguments, show_blocks, unblock
from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed, RsePfError, UsageError
from rse_pf.local.state import read_state, state_folder
from rse_pf.services.custom.installed import install, installed_services, read_service
from rse_pf.services.custom.native import INCLUDE_FOLDER
from rse_pf.terminal import at_work, counted, error_lines, show, show_json, show_progress

__all__ = ["add_arguments", "run"]

Recorded = list[tuple[str, dict[str, Any]]]
"""File name and content of each recorded request."""

_ACTIONS = ("new", "test", "run", "install", "list", "call", "status", "unblock")
_LANGUAGES = ("python", "cpp", "lua")
_NAME = re.compile(r"[a-z][a-z0-9_-]{0,39}")
_POLL_S = 0.3
_DEFAULT_TOLERANCE = 1e-9
_RECORDED_FIELDS = {"request", "reply", "tolerance", "failure"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("action", choices=_ACTIONS, help="what to do")
    parser.add_argument(
        "what", nargs="?", metavar="NAME|FOLDER",
        help="new, call: a name; test, run, install: the folder; unblock: only this service",
    )  # fmt: skip
    parser.add_argument(
        "--lang", choices=_LANGUAGES, default="python", help="new: language (default: python)"
    )
    parser.add_argument("--services", type=Path, metavar="DIR", help="install, list: the services folder")
    parser.add_argument(
        "--request",
        metavar="JSON",
        help="call: the request as JSON; @FILE reads it from a file, which may be a recorded request",
    )
    parser.add_argument(
        "--name", default="default",
        help="call, status, unblock: name of the local platform (default: default)",
    )  # fmt: skip
    add_block_arguments(parser)
    parser.add_argument("--once", action="store_true", help="run: answer the recorded requests, then end")


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Do one of the actions."""
    folder = args.services or _services_folder(settings)
    if args.action == "list":
        return _list(folder)
    if args.action == "status":
        return show_blocks(args)
    if args.action == "unblock":
        return unblock(args)
    if args.what is None:
        what = "name" if args.action in ("new", "call") else "folder"
        raise UsageError(
            f"rse-pf service {args.action} needs the {what} of a service",
            hint=f"write rse-pf service {args.action} {what.upper()}",
        )
    if args.action == "new":
        return _new(args.what, args.lang, Path.cwd())
    if args.action == "call":
        return asyncio.run(_call(args.what, args.request, args.name, settings))
    source = Path(args.what)
    if args.action == "install":
        return _install(source, folder)
    if args.action == "test":
        return _test(source, settings)
    require("service")
    return asyncio.run(_run(source, settings, once=args.once))


# --- new, install, list ---------------------------------------------------------------------------


def _new(name: str, language: str, where: Path) -> int:
    if not _NAME.fullmatch(name):
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
    _build(source)
    service = install(read_service(source).folder, folder)
    show(
        f"{service.name} ({service.language}) is installed in {folder}",
        f"serve it with: rse-pf local --services {folder}",
    )
    return 0


def _list(folder: Path) -> int:
    for service in installed_services(folder):
        show(f"{service.name:<24} {service.language:<8} {service.kind:<18} {service.folder}")
    return 0


def _services_folder(settings: PlatformSettings) -> Path:
    if settings.services.folder:
        return Path(settings.services.folder)
    return state_folder("default", os.environ).parent / "services"


def _build(source: Path) -> None:
    """Build a service that has a CMakeLists.txt and sources newer than its libraries."""
    folder = read_service(source).folder
    if not (folder / "CMakeLists.txt").exists():
        return
    libraries = [path.stat().st_mtime for path in (folder / "build").glob("*.so")]
    if libraries and max(_mtimes(folder, without="build")) <= max(libraries):
        return
    if shutil.which("cmake") is None:
        raise UsageError(
            "cmake is not installed, so the service cannot be built", hint="apt install cmake g++"
        )
    for command in (["cmake", "-S", ".", "-B", "build"], ["cmake", "--build", "build"]):
        with at_work(f"building {folder.name}"):
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            output = (done.stderr or done.stdout).strip()[-1500:]
            raise CommandFailed(f"{' '.join(command)} failed:\n{output}", hint=f"fix the sources in {folder}")
    show(f"built {folder / 'build'}")


def _mtimes(folder: Path, *, without: str) -> Iterable[float]:
    for path in folder.rglob("*"):
        inside = path.relative_to(folder).parts
        if path.is_file() and inside[0] not in (without, "requests") and "__pycache__" not in inside:
            yield path.stat().st_mtime


# --- test -------------------------------------------------------------------------------------------


def _test(source: Path, settings: PlatformSettings) -> int:
    from rse_pf.backend.sandbox.dry_run import dry_run
    from rse_pf.wire import Failure

    _build(source)
    service, recorded = read_service(source), _recorded(source)
    missing, runs = dry_run(service, [each["request"] for _, each in recorded], settings, show)
    if missing:
        show(f"note: this machine lacks isolation that a server has: {', '.join(missing)}")
    wrong = 0
    for (name, each), each_run in zip(recorded, runs, strict=True):
        answer, expected = each_run.answer, each.get("reply")
        if isinstance(answer, Failure):
            detail = f"{answer.code}: {answer.message}"
            good = each.get("failure") == answer.code
        else:
            tolerance = each.get("tolerance", _DEFAULT_TOLERANCE)
            detail = _difference(_plain(answer.reply), expected, tolerance) if "reply" in each else ""
            good = "failure" not in each and not detail
        wrong += not good
        show(f"{name:<28} {'ok' if good else 'WRONG':<6} {each_run.took_ms:8.1f} ms  {detail}")
    show(f"{len(runs) - wrong} of {counted(len(runs), 'recorded request')} as expected")
    return 1 if wrong else 0


def _recorded(source: Path) -> Recorded:
    found = []
    for path in sorted((source / "requests").glob("*.json")):
        try:
            each = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise UsageError(f"{path} is not JSON: {error}", hint="correct the file") from error
        if not isinstance(each, dict) or "request" not in each:
            raise UsageError(f"{path} holds no request", hint='write {"request": {...}, "reply": {...}}')
        found.append((path.name, each))
    if not found:
        raise UsageError(
            f"{source} has no recorded requests", hint=f"write one to {source / 'requests'}/NAME.json"
        )
    return found


def _plain(value: Any) -> Any:
    """Return *value* as JSON gives it back: arrays are lists, and what JSON cannot hold is text."""
    return json.loads(json.dumps(value, default=lambda each: getattr(each, "tolist", each.__repr__)()))


def _difference(got: Any, expected: Any, tolerance: float, path: str = "reply") -> str:
    """Return the first difference of *got* from *expected*, "" if there is none."""
    if isinstance(expected, dict) and isinstance(got, dict):
        if set(got) != set(expected):
            return f"{path} has {', '.join(sorted(got))}, expected {', '.join(sorted(expected))}"
        found = (_difference(got[key], expected[key], tolerance, f"{path}.{key}") for key in expected)
        return next(filter(None, found), "")
    if isinstance(expected, list) and isinstance(got, list):
        if len(got) != len(expected):
            return f"{path} has {len(got)} values, expected {len(expected)}"
        pairs = enumerate(zip(got, expected, strict=True))
        return next(filter(None, (_difference(g, e, tolerance, f"{path}[{i}]") for i, (g, e) in pairs)), "")
    numbers = all(isinstance(each, int | float) and not isinstance(each, bool) for each in (got, expected))
    equal = math.isclose(got, expected, rel_tol=tolerance, abs_tol=tolerance) if numbers else got == expected
    return "" if equal else f"{path} is {got!r}, expected {expected!r}"


# --- run, call --------------------------------------------------------------------------------------


async def _run(source: Path, settings: PlatformSettings, *, once: bool) -> int:
    from rse_pf.local.control.platform import LocalPlatform

    _build(source)
    service, recorded = read_service(source), _recorded(source)
    with tempfile.TemporaryDirectory(prefix="rse-pf-service-") as temporary:
        place = Path(temporary)
        install(service.folder, place / "services")
        chosen = settings.replace(services={"folder": str(place / "services"), "accept_weak_isolation": True})
        stopped = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, stopped.set)
        show_progress("starting a platform ...", is_over=False)
        async with LocalPlatform(
            chosen, state=place / "platform", servers=1, port=0, name="service"
        ) as platform:
            show_progress("", is_over=False)
            show(f"{service.name} is served at {platform.url}")
            good = await _ask_recorded(platform, service, recorded, settings)
            if once:
                return 0 if good else 1
            show(f"save a file in {source} to load it anew; Ctrl-C ends")
            seen = max(_mtimes(service.folder, without="build"))
            while not stopped.is_set():
                try:
                    await asyncio.wait_for(stopped.wait(), _POLL_S)
                except asyncio.TimeoutError:
                    newest = max(_mtimes(service.folder, without="build"))
                    if newest > seen:
                        seen = newest
                        await _reload(platform, source, place / "services", recorded, settings)
    return 0


async def _reload(
    platform: Any, source: Path, services: Path, recorded: Recorded, settings: PlatformSettings
) -> None:
    try:
        _build(source)
        service = install(read_service(source).folder, services)
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
    from rse_pf.backend.sandbox.dry_run import dry_run

    failed = []
    async with connect(platform.url, token=platform.issue_token("robot-1")) as robot:
        for path, each in recorded:
            try:
                answer = await robot.call(service.name, each["request"])
            except RsePfError as error:
                if each.get("failure") != error.code:
                    failed.append(each["request"])
                show(f"{path}: {error.code}: {error.message}")
                continue
            shown = json.dumps(_plain(answer.reply))
            show(f"{path}: {shown[:500]}  ({answer.round_trip_ms:.1f} ms)")
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
    show_json(_plain(answer.reply))
    return 0


def _payload(request: str | None) -> Any:
    text = request or "{}"
    try:
        if text.startswith("@"):
            text = Path(text[1:]).read_text(encoding="utf-8")
        payload = json.loads(text)
    except OSError as error:
        raise UsageError(f"cannot read {request}: {error.strerror}", hint="name a file after @") from error
    except ValueError as error:
        raise UsageError(
            f"--request is not JSON: {error}", hint="write --request '{\"points\": [0, 0, 1]}'"
        ) from error
    if isinstance(payload, dict) and "request" in payload and set(payload) <= _RECORDED_FIELDS:
        return payload["request"]
    return payload
