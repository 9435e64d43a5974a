"""What every test may ask for: the checkout, its sources, and the recordings beside it."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import os
import signal
import subprocess
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from localstack.lacking import LACKING

from rse_pf.processes.one_thread import ONE_THREAD
from tests.kit.emulated_aws import is_localstack

# Before numpy is imported.  BLAS' threads wait for each other where tests share the processors: a test of 6 s
# took more than 120.
os.environ.update(ONE_THREAD)

settings.register_profile("rse-pf", deadline=None)  # a crowded machine is no defect
settings.load_profile("rse-pf")

# moto makes 1,300 images for each of its EC2 regions, most of a second each time: one is enough.
os.environ.setdefault("MOTO_AMIS_PATH", str(Path(__file__).parent / "aws" / "images.json"))

# Programs that tests start and interrupt would ignore SIGINT, as they inherit it of a shell's background job.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

_REPOSITORY = Path(__file__).resolve().parents[1]
_SOURCES = ("rse_pf", "client_sdk", "lambda_pnp", "stacks")


@pytest.fixture(scope="session")
def repository() -> Path:
    """The checkout."""
    return _REPOSITORY


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """Mount a disk of a size such as ``4m``; skips where that is not permitted."""
    disk = tmp_path / "disk"

    def mount(size: str) -> Path:
        disk.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(disk)]
        if os.geteuid() or subprocess.run(command, capture_output=True, check=False).returncode:
            pytest.skip("this machine does not let us mount a tmpfs")
        return disk

    yield mount
    if disk.is_mount():
        subprocess.run(["umount", "--lazy", str(disk)], check=True)


@pytest.fixture
def fill() -> Callable[[Path], Path]:
    """Take every block of a small disk, as another program would; return the file to remove."""

    def take(disk: Path) -> Path:
        hog = disk / "hog"
        with hog.open("ab", buffering=0) as file, contextlib.suppress(OSError):
            while os.statvfs(disk).f_bavail:
                file.write(bytes(4096))
        assert os.statvfs(disk).f_bavail == 0
        return hog

    return take


@pytest.fixture(scope="session")
def sources() -> Mapping[str, str]:
    """Text of every module of the platform, by path from the checkout."""
    files = [file for room in _SOURCES for file in sorted((_REPOSITORY / room).rglob("*.py"))]
    files += [file for file in [_REPOSITORY / "app.py"] if file.exists()]
    return {
        file.relative_to(_REPOSITORY).as_posix(): file.read_text(encoding="utf-8")
        for file in files
        if "__pycache__" not in file.parts and "cdk.out" not in file.parts
    }


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real recordings; tests that need it are skipped where it is missing."""
    folder = _REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no recordings at ../shared/data")
    return folder


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is a coroutine function in an event loop of its own."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    names = inspect.signature(pyfuncitem.obj).parameters
    test = pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in names})

    async def run() -> None:
        await test
        for _ in range(5):  # servers in this loop see the end of the connections that the test has closed
            await asyncio.sleep(0)

    asyncio.run(run())
    return True


_LEFT_OUT: dict[str, int] = {}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Expect the tests to fail whose service LocalStack lacks."""
    if not is_localstack():
        return
    for item in items:
        service = LACKING.get((item.location[0], item.name))
        if service is not None:
            mark = pytest.mark.xfail(reason=f"LocalStack has no {service}", strict=True)
            item.add_marker(mark)


def pytest_deselected(items: list[pytest.Item]) -> None:
    """Remember what the marker left out."""
    for item in items:
        file = item.path.relative_to(_REPOSITORY).as_posix()
        _LEFT_OUT[file] = _LEFT_OUT.get(file, 0) + 1


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Tell the process that prints, where tests run in several."""
    told = getattr(session.config, "workeroutput", None)
    if told is not None:
        told["left_out"] = dict(_LEFT_OUT)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any, error: Any) -> None:
    """Take what a process left out; every one of them saw all tests."""
    _LEFT_OUT.update(getattr(node, "workeroutput", {}).get("left_out", {}))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say what was not run, and how to run it."""
    if _LEFT_OUT:
        terminalreporter.section("left out by the marker; make slow runs them")
        for file, count in sorted(_LEFT_OUT.items()):
            terminalreporter.write_line(f"{count:4d}  {file}")
