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

import argparse
import os
import secrets
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from rse_pf.command_line.extras import require
from rse_pf.config import PlatformSettings, load_settings
from rse_pf.errors import UsageError

if TYPE_CHECKING:
    from rse_pf.extensions.experiments.load.run import TargetPlatform

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add(
        "--scenario",
        type=Path,
        metavar="FILE",
        help="what robots do, such as scenario.json of an earlier run",
    )
    add("--robots", type=int, help="number of robots (default: 10)")
    add("--fps", type=float, help="frames per second of each robot (default: 5, as in the paper)")
    add("--join-every", type=float, metavar="S", help="time between two robots that join (default: 0)")
    add("--seconds", type=float, metavar="S", help="duration after all have joined (default: 20)")
    add("--matches", type=int, help="matches per frame (default: 200)")
    add("--codec", help="zlib (default, as in the paper), json or bin")
    add("--service", help="pnp (default) or echo")
    add("--link", metavar="PROFILE", help="emulate a network: none, paper, wifi-bad or lte")
    add("--deadline", type=float, metavar="S", help="deadline of each command (default: 5)")
    add(
        "--latest-only",
        action="store_true",
        help="let the platform skip a frame when a newer one has arrived",
    )
    add("--processes", type=int, help="processes of the generator (default: 1)")
    add("--seed", type=int, help="seed of problems, jitter and link cuts (default: 0)")
    add("--servers", type=int, help="servers of the platform that is started (default: local.servers)")
    add("--name", help="use the platform that rse-pf local runs under this name")
    add("--url", help="use the platform at this address, with --token-from")
    add("--token-from", metavar="NAME", help="with --url: sign tokens with the key of this local platform")
    add("--out", type=Path, default=Path("out-swarm"), metavar="DIR", help="records (default: out-swarm)")
    add("--record", type=Path, metavar="DIR", help="record what robots and the started servers say in DIR")
    add("--quiet", action="store_true", help="print only the result")


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Check the options and run the swarm."""
    from rse_pf.extensions.experiments.load.run import run_swarm
    from rse_pf.extensions.experiments.load.scenario import LoadScenario, read_scenario
    from rse_pf.extensions.recording.writer import with_recordings

    given = {
        "robots": args.robots, "fps": args.fps, "seconds": args.seconds, "codec": args.codec,
        "matches": args.matches, "seed": args.seed, "join_every_s": args.join_every,
        "deadline_s": args.deadline, "keep": False if args.latest_only else None, "service": args.service,
        "processes": args.processes, "link": args.link,
    }  # fmt: skip
    scenario = LoadScenario() if args.scenario is None else read_scenario(args.scenario)
    scenario = replace(scenario, **{name: value for name, value in given.items() if value is not None})
    platform = _platform(args, settings)
    if platform is None:
        require("swarm")
    if args.servers is not None:
        if platform is not None:
            raise UsageError(
                "--servers needs a platform that is started for the run", hint="leave out --name and --url"
            )
        settings = settings.replace(local={"servers": args.servers})
    if args.record is not None and platform is not None:
        raise UsageError(
            "--record needs a platform that is started for the run",
            hint="start it with rse-pf local --record, or leave out --name and --url",
        )
    if platform is None:
        settings = with_recordings(settings, args.record)
    return run_swarm(scenario, settings, out=args.out, platform=platform, quiet=args.quiet)


def _platform(args: argparse.Namespace, settings: PlatformSettings) -> TargetPlatform | None:
    from rse_pf.extensions.experiments.load.run import TargetPlatform
    from rse_pf.local.firewall import key_file, read_key
    from rse_pf.local.state import read_state, settings_file, state_folder

    name = args.token_from if args.url is not None else args.name
    if args.url is not None and args.name is not None:
        raise UsageError("--name and --url exclude each other", hint="use one of them")
    if args.url is None and args.token_from is not None:
        raise UsageError("--token-from needs --url", hint="use --name alone: it finds address and key")
    if args.url is not None and urlsplit(args.url).scheme not in ("ws", "wss"):
        raise UsageError(f"{args.url!r} is not a WebSocket address", hint="write ws://HOST:PORT/ws")
    if args.url is not None and name is None:
        raise UsageError(
            "--url needs --token-from for tokens", hint="name a local platform with --token-from"
        )
    if name is None:
        return None
    folder = state_folder(name, os.environ)
    state = read_state(folder)
    url = args.url or (state.url if state is not None else "")
    if not url:
        raise UsageError(f"no platform {name!r} is running", hint=f"start it: rse-pf local --name {name}")
    key = read_key(key_file(folder))
    file = settings_file(folder)
    auth = (load_settings(file) if file.exists() and args.settings is None else settings).auth

    def token_of(robot: str) -> str:
        return key.issue(robot, now=time.time(), token_id=secrets.token_hex(8), settings=auth)

    return TargetPlatform(url, token_of)
