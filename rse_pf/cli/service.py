"""Write a service of your own, try it, and run it: in Python, C/C++ or Lua.

new makes a folder with a working service; test replays its recorded requests inside the walls of a server;
run serves it from a local platform until Ctrl-C and loads every saved change; install pins it for
rse-pf local --services; call asks a running local platform.

examples:
  rse-pf service new centroid --lang lua
  rse-pf service test centroid
  rse-pf service run centroid
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

from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed, RsePfError, UsageError

__all__ = ["add_arguments", "run"]

Recorded = list[tuple[str, dict[str, Any]]]
"""Names of files, and what they hold."""

_ACTIONS = ("new", "test", "run", "install", "list", "call")
_LANGUAGES = ("python", "cpp", "lua")
_NAME = re.compile(r"[a-z][a-z0-9_-]{0,39}")
_LOOK_AGAIN_S = 0.3
_DEFAULT_TOLERANCE = 1e-9
_RECORDED_FIELDS = {"request", "reply", "tolerance", "failure"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("action", choices=_ACTIONS, help="what to do")
    parser.add_argument(
        "what", nargs="?", metavar="NAME|FOLDER", help="new, call: a name; test, run, install: the folder"
    )
    parser.add_argument(
        "--lang", choices=_LANGUAGES, default="python", help="new: language (default: python)"
    )
    parser.add_argument("--services", type=Path, metavar="DIR", help="install, list: the services folder")
    parser.add_argument(
        "--request", metavar="JSON", help="call: the request; @FILE reads it, also a recorded one"
    )
    parser.add_argument("--name", default="default", help="call: which local platform (default: default)")
    parser.add_argument("--once", action="store_true", help="run: answer the recorded requests, then end")


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Do one of the actions."""
    folder = args.services or _services_folder(settings)
    if args.action == "list":
        return _list(folder)
    if args.what is None:
        raise UsageError(
            f"rse-pf service {args.action}: say which", hint=f"write rse-pf service {args.action} NAME"
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
    return asyncio.run(_run(source, settings, once=args.once))


# --- new, install, list ---------------------------------------------------------------------------


def _new(name: str, language: str, where: Path) -> int:
    from rse_pf.services.custom.native import INCLUDE_FOLDER

    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{name[:60]!r} is no name for a service", hint="use 1 to 40 small letters, digits, - and _"
        )
    folder = where / name
    if folder.exists():
        raise UsageError(f"{folder} exists already", hint="choose another name, or remove it")
    template = INCLUDE_FOLDER.parent / "templates" / language
    (folder / "requests").mkdir(parents=True)
    for path in sorted(template.iterdir()):
        text = path.read_text(encoding="utf-8").replace("@NAME@", name)
        target = folder / "requests" / path.name if path.name == "example.json" else folder / path.name
        target.write_text(text, encoding="utf-8")
    if language == "cpp":
        shutil.copytree(INCLUDE_FOLDER, folder / "include")
    print(
        f"{folder} is a working service\n\n"
        f"  rse-pf service test {name}     replay its recorded request\n"
        f"  rse-pf service run {name}      serve it, and load every saved change"
    )
    return 0


def _install(source: Path, folder: Path) -> int:
    from rse_pf.services.custom.installed import install, read_service

    _build(source)
    service = install(read_service(source).folder, folder)
    print(
        f"{service.name} ({service.language}) is installed in {folder}\n"
        f"serve it with: rse-pf local --services {folder}"
    )
    return 0


def _list(folder: Path) -> int:
    from rse_pf.services.custom.installed import installed_services

    for service in installed_services(folder):
        print(f"{service.name:<24} {service.language:<8} {service.kind:<18} {service.folder}")
    return 0


def _services_folder(settings: PlatformSettings) -> Path:
    if settings.services.folder:
        return Path(settings.services.folder)
    from rse_pf.local.state import state_folder

    return state_folder("default", os.environ).parent / "services"


def _build(source: Path) -> None:
    """Build a service that has a CMakeLists.txt and sources newer than its libraries."""
    from rse_pf.services.custom.installed import read_service

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
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            told = (done.stderr or done.stdout).strip()[-1500:]
            raise CommandFailed(f"{' '.join(command)} failed:\n{told}", hint=f"mend it in {folder}")
    print(f"built {folder / 'build'}")


def _mtimes(folder: Path, *, without: str) -> Iterable[float]:
    for path in folder.rglob("*"):
        inside = path.relative_to(folder).parts
        if path.is_file() and inside[0] not in (without, "requests") and "__pycache__" not in inside:
            yield path.stat().st_mtime


# --- test -------------------------------------------------------------------------------------------


def _test(source: Path, settings: PlatformSettings) -> int:
    from rse_pf.backend.sandbox.dry_run import try_service
    from rse_pf.services.custom.installed import read_service
    from rse_pf.wire import Failure

    _build(source)
    service, recorded = read_service(source), _recorded(source)
    missing, trials = try_service(service, [each["request"] for _, each in recorded], settings, print)
    if missing:
        print(f"note: this machine lacks walls that a server has: {', '.join(missing)}")
    wrong = 0
    for (name, each), trial in zip(recorded, trials, strict=True):
        answer, expected = trial.answer, each.get("reply")
        if isinstance(answer, Failure):
            told = f"{answer.code}: {answer.message}"
            good = each.get("failure") == answer.code
        else:
            tolerance = each.get("tolerance", _DEFAULT_TOLERANCE)
            told = _difference(_plain(answer.reply), expected, tolerance) if "reply" in each else ""
            good = "failure" not in each and not told
        wrong += not good
        print(f"{name:<28} {'ok' if good else 'WRONG':<6} {trial.took_ms:8.1f} ms  {told}")
    print(f"{len(trials) - wrong} of {len(trials)} recorded requests as expected")
    return 1 if wrong else 0


def _recorded(source: Path) -> Recorded:
    found = []
    for path in sorted((source / "requests").glob("*.json")):
        try:
            each = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise UsageError(f"{path} is not JSON: {error}", hint="mend it") from error
        if not isinstance(each, dict) or "request" not in each:
            raise UsageError(f"{path} holds no request", hint='write {"request": {...}, "reply": {...}}')
        found.append((path.name, each))
    if not found:
        raise UsageError(
            f"{source} has no recorded requests", hint=f"write one to {source / 'requests'}/NAME.json"
        )
    return found


def _plain(value: Any) -> Any:
    import numpy as np

    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    return [_plain(each) for each in value] if isinstance(value, list) else value


def _difference(got: Any, expected: Any, tolerance: float, path: str = "reply") -> str:
    """Return where *got* is not *expected*, or nothing."""
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
    from rse_pf.services.custom.installed import install, read_service

    _build(source)
    service, recorded = read_service(source), _recorded(source)
    with tempfile.TemporaryDirectory(prefix="rse-pf-service-") as temporary:
        place = Path(temporary)
        install(service.folder, place / "services")
        chosen = settings.replace(services={"folder": str(place / "services"), "accept_weak_isolation": True})
        stopped = asyncio.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, stopped.set)
        async with LocalPlatform(
            chosen, state=place / "platform", servers=1, port=0, name="service"
        ) as cloud:
            print(f"{service.name} is served at {cloud.url}", flush=True)
            good = await _ask_recorded(cloud, service, recorded, settings)
            if once:
                return 0 if good else 1
            print(f"save a file in {source} to load it anew; Ctrl-C ends", flush=True)
            seen = max(_mtimes(service.folder, without="build"))
            while not stopped.is_set():
                try:
                    await asyncio.wait_for(stopped.wait(), _LOOK_AGAIN_S)
                except asyncio.TimeoutError:
                    newest = max(_mtimes(service.folder, without="build"))
                    if newest > seen:
                        seen = newest
                        await _reload(cloud, source, place / "services", recorded, settings)
    return 0


async def _reload(
    cloud: Any, source: Path, services: Path, recorded: Recorded, settings: PlatformSettings
) -> None:
    from rse_pf.services.custom.installed import install, read_service

    try:
        _build(source)
        service = install(read_service(source).folder, services)
        await cloud.roll()
        await _ask_recorded(cloud, service, recorded, settings)
    except RsePfError as error:  # the author mends it and saves again
        print(error.report(), flush=True)


async def _ask_recorded(cloud: Any, service: Any, recorded: Recorded, settings: PlatformSettings) -> bool:
    """Let a robot send every recorded request; return whether all were answered.

    A robot is not told why a service failed; its author is: the first such request is tried once more here.
    """
    from client_sdk import connect
    from rse_pf.backend.sandbox.dry_run import try_service

    failed = []
    async with connect(cloud.url, token=cloud.issue_token("robot-1")) as robot:
        for path, each in recorded:
            try:
                answer = await robot.call(service.name, each["request"])
            except RsePfError as error:
                if each.get("failure") != error.code:
                    failed.append(each["request"])
                print(f"{path}: {error.code}: {error.message}", flush=True)
                continue
            shown = json.dumps(_plain(answer.reply))
            print(f"{path}: {shown[:500]}  ({answer.round_trip_ms:.1f} ms)", flush=True)
    if failed:
        await asyncio.to_thread(try_service, service, failed[:1], settings, lambda line: print(f"  {line}"))
    return not failed


async def _call(name: str, request: str | None, platform: str, settings: PlatformSettings) -> int:
    from client_sdk import connect
    from rse_pf.local.firewall import key_file, read_key
    from rse_pf.local.state import read_state, state_folder

    payload, folder = _payload(request), state_folder(platform, os.environ)
    state = read_state(folder)
    if state is None or not state.url:
        raise UsageError(f"no platform named {platform!r} is running", hint="start one with: rse-pf local")
    token = read_key(key_file(folder)).issue(
        "command-line", now=time.time(), token_id=secrets.token_hex(8), settings=settings.auth
    )
    async with connect(state.url, token=token) as robot:
        answer = await robot.call(name, payload)
    print(json.dumps(_plain(answer.reply)))
    return 0


def _payload(request: str | None) -> Any:
    text = request or "{}"
    try:
        if text.startswith("@"):
            text = Path(text[1:]).read_text(encoding="utf-8")
        told = json.loads(text)
    except OSError as error:
        raise UsageError(f"cannot read {request}: {error.strerror}", hint="name a file after @") from error
    except ValueError as error:
        raise UsageError(
            f"--request is not JSON: {error}", hint="write --request '{\"points\": [0, 0, 1]}'"
        ) from error
    recorded = (
        isinstance(told, dict)
        and "request" in told
        and set(told) <= {"request", "reply", "tolerance", "failure"}
    )
    return told["request"] if recorded else told
