"""Load a platform with many robots that send real PnP problems, and measure their round trips.

Send times are fixed before the run and latency counts from them, so that stalls are part of it. Without
--name or --url a platform is started for the run; Ctrl-C ends everything that was started. An option
given here overrides what --scenario says.

examples:
  rse-pf swarm --robots 20 --seconds 10
  rse-pf swarm --robots 100 --fps 5 --link paper --out out-swarm
  rse-pf swarm --name default --robots 50
  rse-pf swarm --scenario out-swarm/scenario.json --codec bin --out again
"""

from __future__ import annotations

import os
import secrets
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from rse_pf.command_line.extras import require
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings, load_settings
from rse_pf.errors import UsageError

if TYPE_CHECKING:
    from rse_pf.extensions.experiments.load.run import TargetPlatform

__all__ = ["ACTION"]


@dataclass(frozen=True, kw_only=True)
class SwarmRequest:
    """Options of ``rse-pf swarm``.

    None for a field of the load means the value of ``--scenario`` or the default.
    """

    settings: Path | None = None
    scenario: Path | None = option(
        "--scenario", metavar="FILE", help="file of the load, such as scenario.json of an earlier run"
    )
    robots: int | None = option("--robots", help="number of robots (default: 10)")
    fps: float | None = option("--fps", help="frames per second of each robot (default: 5, as in the paper)")
    join_every: float | None = option(
        "--join-every", metavar="S", help="time between two robots that join (default: 0)"
    )
    seconds: float | None = option(
        "--seconds", metavar="S", help="duration after all have joined (default: 20)"
    )
    matches: int | None = option("--matches", help="matches per frame (default: 200)")
    codec: str | None = option("--codec", help="zlib (default, as in the paper), json or bin")
    service: str | None = option("--service", help="pnp (default) or echo")
    link: str | None = option(
        "--link", metavar="PROFILE", help="emulate a network: none, paper, wifi-bad or lte"
    )
    deadline: float | None = option("--deadline", metavar="S", help="deadline of each command (default: 5)")
    latest_only: bool = option(
        "--latest-only", help="let the platform skip a frame when a newer one has arrived"
    )
    processes: int | None = option("--processes", help="processes that generate the load (default: 1)")
    seed: int | None = option("--seed", help="seed of problems, jitter and link failures (default: 0)")
    servers: int | None = option(
        "--servers", help="servers of the platform that is started (default: local.servers)"
    )
    name: str | None = option("--name", help="use the platform that rse-pf local runs under this name")
    url: str | None = option("--url", help="use the platform at this address, with --token-from")
    token_from: str | None = option(
        "--token-from", metavar="NAME", help="with --url: sign tokens with the key of this local platform"
    )
    out: Path = option("--out", default=Path("out-swarm"), metavar="DIR", help="records (default: out-swarm)")
    record: Path | None = option(
        "--record", metavar="DIR", help="record the messages of robots and of the started servers in DIR"
    )
    quiet: bool = option("--quiet", help="print only the result")


def swarm(request: SwarmRequest, settings: PlatformSettings) -> int:
    """Check the options, run the load, and return the exit code of `run_swarm`."""
    from rse_pf.extensions.experiments.load.run import run_swarm
    from rse_pf.extensions.experiments.load.scenario import LoadScenario, read_scenario
    from rse_pf.extensions.recording.writer import with_recordings

    renamed = {"join_every": "join_every_s", "deadline": "deadline_s"}
    names = (
        "robots", "fps", "seconds", "codec", "matches", "seed", "join_every", "deadline", "service",
        "processes", "link",
    )  # fmt: skip
    given: dict[str, Any] = {renamed.get(name, name): getattr(request, name) for name in names}
    given["keep"] = False if request.latest_only else None
    scenario = LoadScenario() if request.scenario is None else read_scenario(request.scenario)
    scenario = replace(scenario, **{name: value for name, value in given.items() if value is not None})
    platform = _platform(request, settings)
    if platform is None:
        require("swarm")
    if request.servers is not None:
        if platform is not None:
            raise UsageError(
                "--servers needs a platform that is started for the run", hint="leave out --name and --url"
            )
        settings = settings.replace(local={"servers": request.servers})
    if request.record is not None and platform is not None:
        raise UsageError(
            "--record needs a platform that is started for the run",
            hint="start it with rse-pf local --record, or leave out --name and --url",
        )
    if platform is None:
        settings = with_recordings(settings, request.record)
    return run_swarm(scenario, settings, out=request.out, platform=platform, quiet=request.quiet)


def _platform(request: SwarmRequest, settings: PlatformSettings) -> TargetPlatform | None:
    from rse_pf.extensions.experiments.load.run import TargetPlatform
    from rse_pf.local.firewall import key_file, read_key
    from rse_pf.local.state import read_state, settings_file, state_folder

    name = request.token_from if request.url is not None else request.name
    if request.url is not None and request.name is not None:
        raise UsageError("--name and --url exclude each other", hint="use one of them")
    if request.url is None and request.token_from is not None:
        raise UsageError("--token-from needs --url", hint="use --name alone: it finds address and key")
    if request.url is not None and urlsplit(request.url).scheme not in ("ws", "wss"):
        raise UsageError(f"{request.url!r} is not a WebSocket address", hint="write ws://HOST:PORT/ws")
    if request.url is not None and name is None:
        raise UsageError(
            "--url needs --token-from for tokens", hint="name a local platform with --token-from"
        )
    if name is None:
        return None
    folder = state_folder(name, os.environ)
    state = read_state(folder)
    url = request.url or (state.url if state is not None else "")
    if not url:
        raise UsageError(f"no platform {name!r} is running", hint=f"start it: rse-pf local --name {name}")
    key = read_key(key_file(folder))
    file = settings_file(folder)
    auth = (load_settings(file) if file.exists() and request.settings is None else settings).auth

    def token_of(robot: str) -> str:
        return key.issue(robot, now=time.time(), token_id=secrets.token_hex(8), settings=auth)

    return TargetPlatform(url, token_of)


ACTION = Action(request=SwarmRequest, run=swarm)
