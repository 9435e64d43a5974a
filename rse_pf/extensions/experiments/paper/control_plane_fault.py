"""The fault "control-plane": the control plane is killed, and a new one adopts the running servers.

The platform is started as a user starts it, as the child process ``rse-pf local``.  The platform and the
robots are stopped when `run_control_plane_fault` returns, also after an error.
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
from rse_pf.extensions.experiments.harness import generator_event, policy_parameters
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.extensions.experiments.load.swarm import Swarm
from rse_pf.extensions.experiments.results.records import (
    COMMANDS,
    EVENTS,
    SAMPLES,
    EventLog,
    SampleLog,
    write_commands,
)
from rse_pf.local.firewall import key_file, read_key
from rse_pf.local.processes import STOP_TIMEOUT_S, is_alive
from rse_pf.local.servers.backend_servers import RSE_PF
from rse_pf.local.state import PlatformState, read_state, remove_keys, state_folder, stop_platform

__all__ = ["run_control_plane_fault"]

# Name of the local platform.
_PLATFORM_NAME = "experiment"
# Number of servers of the platform.
_SERVERS = 2
# Seconds under load before the control plane is killed.
_BEFORE_FAULT_S = 4.0
# Seconds under load after the new control plane has started.
_AFTER_RESTART_S = 6.0
# Longest wait until all robots have joined, in seconds.
_JOIN_TIMEOUT_S = 60.0
# Time between two reads of the state file, in seconds.
_STATE_POLL_S = 0.05


async def run_control_plane_fault(
    folder: Path,
    settings: PlatformSettings,
    parameters: Mapping[str, Any],
    robots: LoadScenario,
    down_s: float,
) -> None:
    """Kill the control plane of a platform under load, start it again after *down_s*, and write the records.

    Args:
        folder: Folder of the records.
        settings: Settings of the platform.
        parameters: Parameters of the run, for its first event.
        robots: The load.
        down_s: Seconds without a control plane.

    Raises:
        CommandFailed: The platform did not start, or did not start again.
    """
    home = folder / "platform"
    state_at = state_folder(_PLATFORM_NAME, {"XDG_STATE_HOME": str(home)})
    origin_s = time.monotonic()
    timeout_s = settings.local.start_timeout_s
    with (folder / EVENTS).open("w", encoding="utf-8") as file:
        log = EventLog(file)

        def record(action: str, **details: Any) -> None:
            log.write(time.monotonic() - origin_s, action, **details)

        record("experiment", **parameters, **policy_parameters(settings, 1.0), origin_s=origin_s)
        with (folder / SAMPLES).open("w", newline="", encoding="utf-8") as samples:
            SampleLog(samples)  # writes the header only: the monitor is part of the control plane
        child = _launch(home, settings, folder)
        try:
            before = await _running(state_at, child, None, timeout_s)
            swarm = Swarm(
                robots,
                url=before.url,
                token_of=_token_maker(state_at, settings),
                session=settings.session,
                on_event=lambda event: log.copy(event, float(event["time"])),
                origin=origin_s,
            )
            async with swarm:
                await swarm.start()
                await swarm.wait_joined(_JOIN_TIMEOUT_S)
                await asyncio.sleep(_BEFORE_FAULT_S)
                before = read_state(state_at) or before
                record("processes", when="before", pids=_pids(before))
                record(
                    "fault",
                    fault="kill -9 of the control plane",
                    pid=child.pid,
                    watch_s=down_s + _AFTER_RESTART_S,
                )
                child.send_signal(signal.SIGKILL)
                child.wait()
                await asyncio.sleep(down_s)
                child = _launch(home, settings, folder)
                after = await _running(state_at, child, before, timeout_s)
                record("control-plane-back", pid=child.pid)
                await asyncio.sleep(_AFTER_RESTART_S)
                after = read_state(state_at) or after
                record("processes", when="after", pids=_pids(after))
                result = await swarm.finish()
            await asyncio.to_thread(write_commands, folder / COMMANDS, result.commands)
            record("generator", **generator_event(result))
        finally:
            await asyncio.to_thread(_end, child, state_at, settings)


def _launch(home: Path, settings: PlatformSettings, folder: Path) -> subprocess.Popen[bytes]:
    """Start ``rse-pf local`` with *settings*.

    Its state is below *home*, its output in ``control-plane.log``.
    """
    file = folder / "settings.json"
    if not file.exists():
        file.write_text(json.dumps({"context": {"rse-pf": settings.to_dict()}}), encoding="utf-8")
    command = (
        "local",
        "--name",
        _PLATFORM_NAME,
        "--servers",
        str(_SERVERS),
        "--port",
        "0",
        "--settings",
        str(file),
    )
    with (folder / "control-plane.log").open("ab") as output:
        return subprocess.Popen(
            [*RSE_PF, *command],
            env={**os.environ, "XDG_STATE_HOME": str(home)},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )


async def _running(
    folder: Path, child: subprocess.Popen[bytes], before: PlatformState | None, within_s: float
) -> PlatformState:
    """Wait until the state file names *child* as the control plane and has a URL, and return that state.

    Raises:
        CommandFailed: *child* exited, or this took longer than *within_s* seconds.
    """
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        if child.poll() is not None:
            raise CommandFailed(
                f"rse-pf local ended with exit code {child.returncode}", hint="see control-plane.log"
            )
        state = read_state(folder)
        if state is not None and state.url and state.control_plane.pid == child.pid:
            return state
        await asyncio.sleep(_STATE_POLL_S)
    when = "start" if before is None else "start again"
    raise CommandFailed(f"rse-pf local did not {when} within {within_s:g} s", hint="see control-plane.log")


def _pids(state: PlatformState) -> list[int]:
    return [mark.pid for mark in state.processes() if is_alive(mark)]


def _token_maker(folder: Path, settings: PlatformSettings) -> Any:
    key = read_key(key_file(folder))

    def issue(robot: str) -> str:
        return key.issue(robot, now=time.time(), token_id=secrets.token_hex(8), settings=settings.auth)

    return issue


def _end(child: subprocess.Popen[bytes], folder: Path, settings: PlatformSettings) -> None:
    timeout_s = STOP_TIMEOUT_S
    if child.poll() is None:
        child.send_signal(signal.SIGINT)
        try:
            child.wait(3 * timeout_s)
        except subprocess.TimeoutExpired:
            child.kill()
            child.wait()
    stop_platform(folder, timeout_s)
    remove_keys(folder)
