"""The control plane dies: monitor and scale modifier are killed, the data path goes on, and is adopted.

The platform is a child process here, ``rse-pf local``, as a user runs it; everything that is killed is
killed by its logged pid.  Promises that platform and robots are gone at the end, whatever happened.
"""

from __future__ import annotations

import asyncio
import json
import os
import secrets
import signal
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed
from rse_pf.experiments.load.swarm import Swarm, SwarmOptions
from rse_pf.experiments.paper.harness import generator_facts
from rse_pf.experiments.paper.result_folder import policy_of
from rse_pf.experiments.results.records import EVENTS, SAMPLES, SampleLog
from rse_pf.experiments.results.report import EventLog, write_commands
from rse_pf.local.firewall import key_file, read_key
from rse_pf.local.processes import is_alive
from rse_pf.local.servers.backend_servers import RSE_PF
from rse_pf.local.shutdown import stop_platform
from rse_pf.local.state import PlatformState, read_state, state_folder

__all__ = ["play_control_plane"]

_NAME = "experiment"
_SERVERS = 2
_LEAD_S = 4.0
_AFTER_S = 6.0
_JOIN_S = 60.0
_LOOK_AGAIN_S = 0.05


async def play_control_plane(
    folder: Path, settings: PlatformSettings, asked: Mapping[str, Any], robots: SwarmOptions, down_s: float
) -> None:
    """Run a platform, kill its control plane for *down_s* under load, start it again; write the records.

    Raises:
        CommandFailed: A platform did not start, or did not come back.
    """
    home = folder / "platform"
    state_at = state_folder(_NAME, {"XDG_STATE_HOME": str(home)})
    origin_s = time.monotonic()
    timeout_s = settings.local.start_timeout_s
    with (folder / EVENTS).open("w", encoding="utf-8") as file:
        log = EventLog(file)

        def tell(action: str, **details: Any) -> None:
            log.write(time.monotonic() - origin_s, action, **details)

        tell("experiment", **asked, **policy_of(settings, 1.0), origin_s=origin_s)
        with (folder / SAMPLES).open("w", newline="", encoding="utf-8") as samples:
            SampleLog(samples)  # the monitor dies in this scenario; nobody else reads the servers
        child = _launch(home, settings, folder)
        try:
            before = await _running(state_at, child, None, timeout_s)
            swarm = Swarm(
                robots,
                url=before.url,
                token_of=_token_maker(state_at, settings),
                session=settings.session,
                on_event=lambda event: log.write(
                    float(event["time"]), str(event["event"]), **_details(event)
                ),
                origin=origin_s,
            )
            async with swarm:
                await swarm.start()
                await swarm.wait_joined(_JOIN_S)
                await asyncio.sleep(_LEAD_S)
                before = read_state(state_at) or before
                tell("processes", when="before", pids=_pids(before))
                tell("fault", fault="kill -9 of the control plane", pid=child.pid, watch_s=down_s + _AFTER_S)
                child.send_signal(signal.SIGKILL)
                child.wait()
                await asyncio.sleep(down_s)
                child = _launch(home, settings, folder)
                after = await _running(state_at, child, before, timeout_s)
                tell("control-plane-back", pid=child.pid)
                await asyncio.sleep(_AFTER_S)
                after = read_state(state_at) or after
                tell("processes", when="after", pids=_pids(after))
                result = await swarm.finish()
            await asyncio.to_thread(write_commands, folder / "commands.csv", result.commands)
            tell("generator", **generator_facts(result))
        finally:
            await asyncio.to_thread(_end, child, state_at, settings)


def _launch(home: Path, settings: PlatformSettings, folder: Path) -> subprocess.Popen[bytes]:
    """Start ``rse-pf local`` with the same settings as every other scenario."""
    file = folder / "settings.json"
    if not file.exists():
        file.write_text(json.dumps({"context": {"rse-pf": settings.to_dict()}}), encoding="utf-8")
    words = ("local", "--name", _NAME, "--servers", str(_SERVERS), "--port", "0", "--settings", str(file))
    with (folder / "control-plane.log").open("ab") as output:
        return subprocess.Popen(
            [*RSE_PF, *words],
            env={**os.environ, "XDG_STATE_HOME": str(home)},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


async def _running(
    folder: Path, child: subprocess.Popen[bytes], before: PlatformState | None, within_s: float
) -> PlatformState:
    """Return the platform's state once *child* is its control plane and its front door is open."""
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        if child.poll() is not None:
            raise CommandFailed(
                f"rse-pf local ended with exit code {child.returncode}", hint="see control-plane.log"
            )
        state = read_state(folder)
        if state is not None and state.url and state.control_plane.pid == child.pid:
            return state
        await asyncio.sleep(_LOOK_AGAIN_S)
    when = "start" if before is None else "come back"
    raise CommandFailed(f"rse-pf local did not {when} within {within_s:g} s", hint="see control-plane.log")


def _pids(state: PlatformState) -> list[int]:
    return [mark.pid for mark in state.processes() if is_alive(mark)]


def _token_maker(folder: Path, settings: PlatformSettings) -> Any:
    key = read_key(key_file(folder))

    def issue(robot: str) -> str:
        return key.issue(robot, now=time.time(), token_id=secrets.token_hex(8), settings=settings.auth)

    return issue


def _end(child: subprocess.Popen[bytes], folder: Path, settings: PlatformSettings) -> None:
    timeout_s = settings.local.stop_timeout_s
    if child.poll() is None:
        child.send_signal(signal.SIGINT)
        try:
            child.wait(3 * timeout_s)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
    stop_platform(folder, timeout_s)
    for secret in folder.glob("key*.json"):
        secret.unlink()


def _details(event: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in event.items() if name not in ("event", "time", "action")}
