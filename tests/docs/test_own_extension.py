"""The extension of `docs/howto/own_extension.md`: built, installed and run as the page says."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

import pytest

from tests.kit.documentation_pages import ROOT

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(300)]

PAGE = (ROOT / "docs/howto/own_extension.md").read_text(encoding="utf-8")
PROGRAM = [sys.executable, "-m", "rse_pf.cli.main"]


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Install the files of the page; return the variables with which its commands run."""
    (tmp_path / "rse_pf_traffic").mkdir()
    (tmp_path / "rse_pf_traffic/__init__.py").touch()
    (project,) = re.findall(r"^```toml\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    (tmp_path / "pyproject.toml").write_text(project)
    for name, text in re.findall(r"<!-- file: (\S+) -->\n```python\n(.*?)^```", PAGE, re.DOTALL | re.M):
        (tmp_path / name).write_text(text)
    installed = tmp_path / "installed"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--target", str(installed), "."], cwd=tmp_path, check=True, timeout=120)
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join((str(installed), str(ROOT))),
        "PYTHONUNBUFFERED": "1",
        "XDG_STATE_HOME": str(tmp_path / "state"),
    }


@pytest.fixture
def platform(environment: dict[str, str], tmp_path: Path) -> Iterator[None]:
    """A platform of one server that robots can connect to."""
    local = [*PROGRAM, "local", "--no-page", "--servers", "1", "--port", "0"]
    with running(local, environment, tmp_path, ready="ws://"):
        yield


@contextmanager
def running(words: list[str], environment: dict[str, str], folder: Path, *, ready: str) -> Iterator[None]:
    """Run a program, wait until it prints *ready*, and end it by Ctrl-C."""
    with subprocess.Popen(
        words, env=environment, cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as process:
        try:
            assert process.stdout is not None
            printed = ""
            while ready not in printed:
                line = process.stdout.readline()
                assert line, printed
                printed += line
            yield
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=60)


def run(environment: dict[str, str], folder: Path, *words: str) -> str:
    done = subprocess.run(
        [*PROGRAM, *words],
        env=environment,
        cwd=folder,
        text=True,
        capture_output=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.usefixtures("platform")
def test_the_extension_of_the_page_works(environment: dict[str, str], tmp_path: Path) -> None:
    assert "Count the messages of a robot by direction and type." in run(environment, tmp_path, "--help")

    run(environment, tmp_path, "robot", "enrol", "robot-1", "--out", "robot-1.enrolment")
    traffic = run(environment, tmp_path, "traffic", "robot-1.enrolment")
    assert re.search(r"^up +Command +3 messages +\d+ bytes$", traffic, re.MULTILINE)
    assert re.search(r"^down +Result +3 messages +\d+ bytes$", traffic, re.MULTILINE)

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    page = [*PROGRAM, "servers-page", "--port", port]
    with (
        running(page, environment, tmp_path, ready="http://"),
        urlopen(f"http://127.0.0.1:{port}", timeout=20) as answer,
    ):
        assert b"<p>server-1: " in answer.read()
