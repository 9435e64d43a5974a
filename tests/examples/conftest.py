"""One platform for all examples, robots that are enrolled there, and programs that run as processes."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Coroutine, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import pytest

from rse_pf.auth.robot_key import make_robot_key
from rse_pf.auth.roster import EnrolledRobot, public_key_of
from rse_pf.auth.tokens import SigningKey
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.config import PlatformSettings
from rse_pf.enrolment import Enrolment
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.services.custom.installed import install
from rse_pf.storage.object_store import DirectoryStore
from tests.kit.delaying_proxy import DelayingProxy
from tests.kit.example_page import PAGE, REPOSITORY, listed

T = TypeVar("T")
ROBOTS = ("robot-1", "robot-2", "robot-4")
OWN_KEY_ROBOT = "robot-3"
SERVICE = REPOSITORY / "examples" / "robots" / "object_recognition_service"
START_S, END_S = 60.0, 110.0
_ROWS = listed(PAGE.read_text(encoding="utf-8"))
_QUIET = {"PYTHONPATH": str(REPOSITORY), "PYTHONUNBUFFERED": "1", "OPENBLAS_NUM_THREADS": "1"}


class Program:
    """An example that runs, read line by line."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.said = ""

    def until(self, words: str) -> str:
        """Return the next line that contains *words*."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.said += line
            if words in line:
                return line
        raise AssertionError(f"it ended without {words!r}:\n{self.said}")

    def interrupt(self) -> int:
        """End it as Ctrl-C does; return its exit code."""
        self.process.send_signal(signal.SIGINT)
        self.said += self.process.communicate(timeout=END_S)[0]
        return self.process.returncode

    def end(self) -> None:
        """Kill what is left."""
        self.process.kill()
        self.process.communicate()


@dataclass(frozen=True)
class ExamplePlatform:
    """A platform in a thread; ``folder`` holds what the commands of the page name."""

    loop: asyncio.AbstractEventLoop
    cloud: LocalPlatform
    folder: Path
    enrolments: dict[str, Enrolment]

    def wait(self, work: Coroutine[Any, Any, T]) -> T:
        """Run *work* in the loop of the platform."""
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(END_S)

    def command(self, example: str, *more: str, **instead: str) -> list[str]:
        """Return the command of the page for *example*, with *more* words and some of its words replaced."""
        words = _ROWS[f"examples/robots/{example}.py"][1]
        changed = [instead.get(word, word) for word in words[2:]]
        return [sys.executable, str(REPOSITORY / words[1]), *changed, *more]

    def run(self, command: list[str]) -> subprocess.CompletedProcess[str]:
        """Run an example to its end."""
        return subprocess.run(
            command, cwd=self.folder, env={**os.environ, **_QUIET}, capture_output=True, text=True,
            timeout=END_S, check=False,
        )  # fmt: skip

    def start(self, command: list[str]) -> Program:
        """Start an example in the background; its errors are among its lines."""
        process = subprocess.Popen(
            command, cwd=self.folder, env={**os.environ, **_QUIET}, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        return Program(process)

    def enrolment_at(self, url: str, name: str) -> str:
        """Write the enrolment of robot-1 for another address; return the name of the file."""
        found = self.enrolments["robot-1"]
        Enrolment(url=url, robot=found.robot, key=found.key).write(self.folder / name)
        return name


@pytest.fixture(scope="module")
def platform(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[ExamplePlatform]:
    """A platform of one server with the service of the examples; robots-1 to 4 are enrolled.

    It has a data service if the module of the test says ``HAS_DATA``, and lets pages of its
    ``ALLOWED_ORIGINS`` connect.
    """
    folder = tmp_path_factory.mktemp("examples")
    state = folder / "platform"
    state.mkdir(mode=0o700)
    keys = {name: json.loads(SigningKey.of_robot(name.encode() * 4 + b"eeee").to_json()) for name in ROBOTS}
    publics = {name: key["x"] for name, key in keys.items()}
    publics[OWN_KEY_ROBOT] = public_key_of(make_robot_key(folder / "robot.key"))
    access = AccessControlStore(DirectoryStore(state))
    for name, x in publics.items():
        access.change_roster(lambda roster, name=name, x=x: roster.enrolled(EnrolledRobot(robot=name, x=x)))
    install(SERVICE, folder / "services")
    settings = PlatformSettings().replace(
        auth={"leeway_s": 1},
        local={"start_timeout_s": START_S},
        services={"folder": str(folder / "services"), "accept_weak_isolation": True},
        serving={"allowed_origins": getattr(request.module, "ALLOWED_ORIGINS", "")},
    )
    cloud = LocalPlatform(
        settings, state=state, servers=1, port=0, data=getattr(request.module, "HAS_DATA", False)
    )
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, name="platform-of-the-examples")
    thread.start()
    made = ExamplePlatform(loop, cloud, folder, {})
    try:
        made.wait(cloud.__aenter__())
        for name, key in keys.items():
            made.enrolments[name] = Enrolment(url=cloud.url, robot=name, key=key)
            made.enrolments[name].write(folder / f"{name}.enrolment")
        yield made
    finally:
        made.wait(cloud.__aexit__(None, None, None))
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


@pytest.fixture
def start(platform: ExamplePlatform) -> Iterator[Callable[[list[str]], Program]]:
    """A function that starts an example in the background; the test ends it, however it ends."""
    with contextlib.ExitStack() as ends:

        def started(command: list[str]) -> Program:
            program = platform.start(command)
            ends.callback(program.end)
            return program

        yield started


@pytest.fixture
def relay(platform: ExamplePlatform) -> Iterator[DelayingProxy]:
    """A way to the platform that a test can cut."""
    made = DelayingProxy(platform.cloud.port, delay_s=0.0)
    platform.wait(made.listen())
    yield made
    platform.wait(made.die())
