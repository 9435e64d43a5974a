"""``rse-pf local --burst``: a robot whose server is gone is answered by the function."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest

import client_sdk
from rse_pf.errors import Expired
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
