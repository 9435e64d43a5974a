"""The packages of `make release` as users install them: in an empty environment of each Python.

A file of tests in an order: what the base install can do and lacks, and then the command of its hint.
"""

from __future__ import annotations

import contextlib
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.system, pytest.mark.timeout(900)]

VERSIONS = ("3.10", "3.11", "3.12", "3.13")
ROBOT = """
import asyncio, sys
from client_sdk import connect
from rse_pf.pnp import solve_pnp
from rse_pf.pnp.problems import make_problem

problem = make_problem(seed=5)
matches = problem.points_world, problem.pixels, problem.camera

async def main(url, token):
    async with connect(url, token=token) as robot:
        answer = await robot.solve_pnp(*matches, deadline_s=5.0)
        print(answer.source, answer.solution.verdict, len(answer.solution.inliers) > 100)

asyncio.run(main(*sys.argv[1:3]))
print(solve_pnp(*matches).engine)
"""


@dataclass(frozen=True)
class Environment:
    """A virtual environment, with a home and a working folder of its own."""

    folder: Path

    @property
    def work(self) -> Path:
        return self.folder / "work"

    @property
    def variables(self) -> dict[str, str]:
        home = str(self.folder / "home")
        path = f"{self.folder / 'venv' / 'bin'}:/usr/local/bin:/usr/bin:/bin"
        return {"PATH": path, "HOME": home, "XDG_STATE_HOME": home, "LANG": "C.UTF-8", "TERM": "dumb"}

    def run(self, typed: str, timeout_s: float = 120.0) -> subprocess.CompletedProcess[str]:
        """Return what a command did that was typed in the working folder."""
        return subprocess.run(
            shlex.split(typed), cwd=self.work, env=self.variables, stdin=subprocess.DEVNULL,
            capture_output=True, text=True, timeout=timeout_s, check=False,
        )  # fmt: skip

    def install(self, typed: str) -> None:
        """Run a command of pip, which may use its cache; skips the test without an index."""
        words = shlex.split(typed)
        assert words[:2] == ["pip", "install"]
        kept = {
            name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL"))
        }
        python = str(self.folder / "venv" / "bin" / "python")
        done = subprocess.run(
            [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *words[2:]],
            cwd=self.work, env=kept, capture_output=True, text=True, timeout=300, check=False,
        )  # fmt: skip
        if "No matching distribution" in done.stderr or "connection" in done.stderr.lower():
            pytest.skip("no package index to install the dependencies from")
        assert done.returncode == 0, done.stderr

    @contextlib.contextmanager
    def running(self, typed: str) -> Iterator[list[str]]:
        """Run a verb that lasts until it is interrupted; yields its lines until it was ready."""
        process = subprocess.Popen(
            shlex.split(typed), cwd=self.work, env=self.variables, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        lines: list[str] = []
        try:
            assert process.stdout is not None
            for line in process.stdout:
                lines.append(line)
                if "robots connect to" in line:
                    break
            else:
                raise AssertionError(f"{typed} was never ready:\n{''.join(lines)}")
            yield lines
            process.send_signal(signal.SIGINT)
            rest, _ = process.communicate(timeout=60)
            assert "Traceback" not in rest, rest
            assert process.returncode in (0, 130), rest
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()


def find_python(version: str) -> str | None:
    """Return an interpreter of *version*: this one, one of the path, of pyenv or of uv."""
    if version == f"{sys.version_info[0]}.{sys.version_info[1]}":
        return sys.executable
    roots = (
        Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions",
        Path.home() / ".local/share/uv/python",
    )
    managed = [
        str(found)
        for root in roots
        for pattern in (f"{version}.*/bin/python", f"cpython-{version}.*/bin/python3")
        for found in sorted(root.glob(pattern))
    ]
    candidates = [*managed, *filter(None, [shutil.which(f"python{version}")])]
    check = "import sys, venv, ensurepip; print('%d.%d' % sys.version_info[:2])"
    for each in candidates:  # a shim in the path may be of another version, or of none
        told = subprocess.run([each, "-c", check], capture_output=True, text=True, timeout=30, check=False)
        if told.stdout.strip() == version:
            return each
    return None


def empty_environment(folder: Path, python: str) -> Environment:
    for name in ("work", "home"):
        (folder / name).mkdir(parents=True)
    subprocess.run([python, "-m", "venv", str(folder / "venv")], check=True, timeout=120)
    return Environment(folder)


@pytest.fixture(scope="module")
def release(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that make release writes, with the native core of this machine.

    RSE_PF_RELEASE names one that was built before, for example the one that will be published.
    """
    if "RSE_PF_RELEASE" in os.environ:
        return Path(os.environ["RSE_PF_RELEASE"]).absolute()
    if not (repository / ".git").exists():
        pytest.skip("no checkout of git")
    folder = tmp_path_factory.mktemp("release")
    made = subprocess.run(
        ["sh", "scripts/release.sh", str(folder), platform.machine()],
        cwd=repository, capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert made.returncode == 0, made.stdout + made.stderr
    return folder


@pytest.fixture(scope="module")
def served(release: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Environment]]:
    """The address of a platform that was installed from the packages, and its environment."""
    there = empty_environment(tmp_path_factory.mktemp("platform"), sys.executable)
    (wheel,) = release.glob("rse_pf-*.whl")
    there.install(f"pip install '{wheel}[demo]' {shlex.join(map(str, release.glob('rse_pf_native-*.whl')))}")
    with there.running("rse-pf local --servers 1 --port 0") as lines:
        yield lines[-1].split()[-1], there


@pytest.fixture(scope="module", params=VERSIONS)
def robot(
    release: Path, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Environment:
    """The base install of one Python: first as it is, later with the extra of a hint."""
    python = find_python(request.param)
    if python is None:
        pytest.skip(f"no Python {request.param} in the path, in ~/.pyenv or of uv")
    made = empty_environment(tmp_path_factory.mktemp(f"python{request.param}"), python)
    wheels = [*release.glob("rse_pf-*.whl"), *release.glob("rse_pf_native-*.whl")]
    made.install(f"pip install {shlex.join(map(str, wheels))}")
    return made


def examples_of_verbs(there: Environment) -> dict[str, str]:
    """Return verb to the first example of its help page."""
    verbs = there.run("python -c 'from rse_pf.cli.main import VERBS; print(*VERBS)'").stdout.split()
    assert len(verbs) > 10
    found = {}
    for verb in verbs:
        page = there.run(f"rse-pf {verb} --help")
        assert (page.returncode, page.stderr) == (0, ""), verb
        (found[verb],) = re.findall(r"^examples?:\n +(rse-pf .+)$", page.stdout, re.M)
    return found


def complaint_about(verb: str, done: subprocess.CompletedProcess[str]) -> str:
    """Return what is wrong with the way in which an example ended; empty if a user can go on from there."""
    told = done.stdout + done.stderr
    errors = done.stderr.splitlines()
    if "Traceback" in told or done.returncode not in (0, 1, 2):
        return f"{verb}: {done.returncode}: {told[-2000:]}"
    if done.returncode == 2 and not (len(errors) == 2 and errors[1].startswith("  hint: ")):
        return f"{verb}: not two lines: {errors}"
    return ""


def test_a_robot_gets_its_first_pose_from_the_base_install(
    robot: Environment, served: tuple[str, Environment]
) -> None:
    url, there = served
    token = there.run("rse-pf token issue robot-1").stdout.strip()
    (robot.work / "robot.py").write_text(ROBOT, encoding="utf-8")

    told = robot.run(f"python robot.py {url} {token}")

    assert told.stderr == ""
    assert told.stdout.splitlines() == ["cloud ok True", "native"]


def test_the_base_install_names_the_missing_extra_of_every_verb_in_two_lines(robot: Environment) -> None:
    ended = {verb: robot.run(example) for verb, example in examples_of_verbs(robot).items()}

    assert [text for verb, done in ended.items() if (text := complaint_about(verb, done))] == []
    hints = {
        verb: done.stderr.splitlines()[-1] for verb, done in ended.items() if "MissingExtra" in done.stderr
    }
    assert hints == {
        "demo": "  hint: pip install 'rse-pf[demo]'",
        "experiment": "  hint: pip install 'rse-pf[experiments]'",
        "local": "  hint: pip install 'rse-pf[local]'",
        "swarm": "  hint: pip install 'rse-pf[local]'",
        "data": "  hint: pip install 'rse-pf[backend]'",
        "check": "  hint: pip install 'rse-pf[demo]'",
        "cloud": "  hint: pip install 'rse-pf[aws]'",
        "compare": "  hint: pip install 'rse-pf[demo]'",
        "fleet": "  hint: pip install 'rse-pf[local]'",
        "replay": "  hint: pip install 'rse-pf[local]'",
    }, "the others fail for another reason first, or work"


def test_the_command_of_the_hint_is_all_that_the_demo_needs(robot: Environment) -> None:
    hint = robot.run("rse-pf demo").stderr.splitlines()[-1]
    started_s = time.monotonic()

    robot.install(hint.partition("hint: ")[2])
    print(f"{hint}: {time.monotonic() - started_s:.0f} s, load average {os.getloadavg()[0]:.1f}")
    done = robot.run("rse-pf demo --robots 1 --frames 12 --quiet --out out-demo")

    assert (done.returncode, done.stderr) == (0, "")
    assert "1 robot tracked 12 frames, 0 lost" in done.stdout
    assert (robot.work / "out-demo" / "robot-1" / "map.ply").is_file()
