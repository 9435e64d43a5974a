"""``rse-pf local --burst``: a robot whose server is gone or too small is answered by the function."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

import client_sdk
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings, SessionSettings
from rse_pf.errors import Expired, RsePfError
from rse_pf.pnp.problems import make_problem

pytestmark = [pytest.mark.system, pytest.mark.slow]

RSE_PF = [sys.executable, "-m", "rse_pf.cli.main"]


def free_port() -> int:
    with socket.socket() as trial:
        trial.bind(("127.0.0.1", 0))
        port: int = trial.getsockname()[1]
        return port


def test_a_robot_of_a_local_platform_is_answered_by_the_function_while_its_server_is_stopped(
    tmp_path: Path,
) -> None:
    environment = {**os.environ, "XDG_STATE_HOME": str(tmp_path)}
    process = subprocess.Popen(
        [*RSE_PF, "local", "--port", "0", "--metrics-port", "0", "--servers", "1", "--no-page", "--no-data",
         "--burst", str(free_port())],
        env=environment, cwd=tmp_path, text=True, stdout=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        said = ""
        for line in process.stdout:
            said += line
            if "burst function" in line:
                break
        url = said.partition("robots connect to")[2].split()[0]
        token = subprocess.run(
            [*RSE_PF, "token", "issue", "robot-1"], env=environment, cwd=tmp_path, text=True,
            capture_output=True, timeout=60, check=True,
        ).stdout.strip()  # fmt: skip
        pause = [*RSE_PF, "local", "pause", "server-1"]
        answers = asyncio.run(_without_server(url, token, pause, environment))
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)

    assert (answers[0].source, answers[-1].source) == ("cloud", "burst")
    assert answers[-1].server == "lambda"


async def _without_server(url: str, token: str, pause: list[str], environment: dict[str, str]) -> list[Any]:
    problem = make_problem(seed=2)
    frame = (problem.points_world, problem.pixels, problem.camera)
    async with client_sdk.connect(url, token=token, random=Random(1)) as robot:
        answers = [await robot.solve_pnp(*frame, deadline_s=20.0)]
        paused = await asyncio.create_subprocess_exec(
            *pause, env=environment, stdout=asyncio.subprocess.DEVNULL
        )
        assert await paused.wait() == 0
        # The first execution has to be started; and after some seconds the server is replaced.
        while answers[-1].source == "cloud" and len(answers) < 4:
            with contextlib.suppress(Expired):
                answers.append(await robot.solve_pnp(*frame, deadline_s=0.9))
    for answer in answers:
        np.testing.assert_allclose(answer.solution.T_camera_world, problem.T_camera_world, atol=0.05)
    return answers


ROBOTS, FRAMES, RATE_HZ, DEADLINE_S = 10, 24, 4.0, 1.0
BUDGET = 10
KEY = SigningKey.from_seed(b"b" * 32, "burst")


@dataclass
class Answered:
    """What became of the frames of all robots: answers in time, wrong poses, and who answered."""

    in_time: int = 0
    wrong: int = 0
    servers_of_burst: set[str] = field(default_factory=set)
    most_at_function: int = 0


def write_settings(folder: Path, url: str) -> None:
    burst = {"url": url, "robot_commands_per_day": BUDGET}
    document = {"context": {"rse-pf": PlatformSettings.from_dict({"burst": burst}).to_dict()}}
    (folder / "settings.json").write_text(json.dumps(document))


@contextlib.contextmanager
def running(*command: str) -> Iterator[subprocess.Popen[bytes]]:
    with subprocess.Popen([sys.executable, "-m", *command], stdout=subprocess.PIPE) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(30)


def drive_against_a_small_server(folder: Path, *, has_burst: bool, dies: bool = False) -> Answered:
    """Let robots ask a server of a hundredth of a core, and perhaps the function; perhaps the server dies."""
    (folder / "keys.json").write_text(KEY.key_set().to_json())
    write_settings(folder, "")
    announce = folder / "server.json"
    announce.unlink(missing_ok=True)
    with contextlib.ExitStack() as stack:
        if has_burst:
            front = stack.enter_context(running("lambda_pnp.local_front", str(folder)))
            assert front.stdout is not None
            write_settings(folder, json.loads(front.stdout.readline())["url"])
        server = stack.enter_context(
            running(
                "rse_pf.cli.main",
                "serve",
                "--settings",
                str(folder / "settings.json"),
                "--keys",
                str(folder / "keys.json"),
                "--port",
                "0",
                "--control-port",
                "0",
                "--workers",
                "1",
                "--emulated-cores",
                "0.01",
                "--announce",
                str(announce),
            )
        )
        end_s = time.monotonic() + 120.0
        while not announce.exists():
            assert server.poll() is None
            assert time.monotonic() < end_s
            os.sched_yield()
        port = json.loads(announce.read_text())["port"]
        return asyncio.run(drive(f"ws://127.0.0.1:{port}/ws", server if dies else None))


async def drive(url: str, dying: subprocess.Popen[bytes] | None) -> Answered:
    """Ask for the poses of all robots at fixed times, also while earlier ones wait."""
    problems = [make_problem(seed=seed) for seed in range(16)]
    answered, loop = Answered(), asyncio.get_running_loop()

    async def ask(robot: client_sdk.Robot, number: int, due: float) -> None:
        await asyncio.sleep(max(0.0, due - loop.time()))
        problem, left_s = problems[number % len(problems)], max(0.001, due + DEADLINE_S - loop.time())
        frame = problem.points_world, problem.pixels, problem.camera
        try:
            answer = await robot.solve_pnp(*frame, deadline_s=left_s, keep=True)
        except RsePfError:
            return
        answered.in_time += loop.time() - due <= DEADLINE_S
        answered.wrong += bool(np.abs(answer.solution.T_camera_world - problem.T_camera_world).max() > 0.1)
        if answer.source == "burst":
            answered.servers_of_burst.add(answer.server)

    async with contextlib.AsyncExitStack() as stack:
        robots = []
        for number in range(ROBOTS):
            token = KEY.issue(
                f"robot-{number}", now=time.time(), token_id=str(number), settings=PlatformSettings().auth
            )
            session = SessionSettings(connect_timeout_s=20.0)
            robots.append(
                await stack.enter_async_context(client_sdk.connect(url, token=token, settings=session))
            )
        begins_s = loop.time() + 0.5
        if dying is not None:
            loop.call_at(begins_s + FRAMES / RATE_HZ * 2 / 3, dying.kill)
        await asyncio.gather(
            *(
                ask(robot, number, begins_s + (number + place / ROBOTS) / RATE_HZ)
                for place, robot in enumerate(robots)
                for number in range(FRAMES)
            )
        )
        answered.most_at_function = max(robot.stats.sent_to_burst for robot in robots)
    return answered


def test_a_server_that_is_too_small_and_the_function_answer_more_than_the_server_alone(
    tmp_path: Path,
) -> None:
    alone = drive_against_a_small_server(tmp_path, has_burst=False)
    helped = drive_against_a_small_server(tmp_path, has_burst=True)
    dying = drive_against_a_small_server(tmp_path, has_burst=True, dies=True)

    assert helped.in_time > alone.in_time
    assert helped.servers_of_burst == {"lambda"}
    assert helped.wrong == dying.wrong == 0
    assert max(helped.most_at_function, dying.most_at_function) <= BUDGET
