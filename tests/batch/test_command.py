"""`rse-pf batch run merge`, killed in the middle, is continued by the same command."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from rse_pf.maps.format import encode_map
from rse_pf.maps.registry import MapRegistry
from rse_pf.storage.object_store import DirectoryStore
from tests.kit.synthetic_maps import make_world

pytestmark = pytest.mark.slow

for package in ("distributed", "gtsam"):
    pytest.importorskip(package, reason="the extra batch is not installed")

MERGE = ("run", "merge", "a", "b", "--out", "hall", "--json")
LONG_ENOUGH_S = 60.0


@pytest.fixture
def store(tmp_path: Path) -> Path:
    folder = tmp_path / "store"
    folder.mkdir()
    world = make_world(1)
    maps = MapRegistry(DirectoryStore(folder))
    for name, first, last, seed in (("a", 0.0, 0.5, 1), ("b", 0.3, 0.8, 2)):
        version, _ = world.walk(name, np.linspace(first, last, 13), seed=seed)
        maps.commit(name, encode_map(version), parent=None, author="a test", created_s=1.0)
    settings = {"context": {"rse-pf": {"batch": {"pairs_per_part": 10}}}}
    (tmp_path / "settings.json").write_text(json.dumps(settings))
    return folder


def begun(store: Path, *workers: str) -> subprocess.Popen[str]:
    settings = ["--settings", str(store.parent / "settings.json")]
    options = ["--store", f"dir:{store}", *(workers or ("--workers", "1"))]
    return subprocess.Popen(
        [sys.executable, "-m", "rse_pf.cli.main", "batch", *settings, *MERGE, *options],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def links_in(store: Path) -> int:
    return sum("/links-" in each.name for each in DirectoryStore(store).list("batch/parts/"))


def children_of(pid: int) -> list[int]:
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def wait_until(is_so: Callable[[], bool], within_s: float = LONG_ENOUGH_S) -> None:
    until = time.monotonic() + within_s
    while not is_so():
        assert time.monotonic() < until, "it did not happen in time"
        threading.Event().wait(0.01)


def test_the_same_command_continues_after_a_kill(store: Path) -> None:
    first = begun(store)
    wait_until(lambda: links_in(store) >= 3)
    children = children_of(first.pid)
    first.kill()
    first.communicate()
    wait_until(lambda: not any(Path(f"/proc/{pid}/environ").exists() for pid in children))
    kept = links_in(store)

    second = begun(store)
    reported, errors = second.communicate(timeout=100)

    assert second.returncode == 0, errors
    answer = json.loads(reported)
    assert answer["joined"] == ["a", "b"]
    assert answer["parts"]["found"] >= kept >= 3
    assert MapRegistry(DirectoryStore(store)).head("hall").keyframes == 26
    assert not list(DirectoryStore(store).list("batch/"))


def test_ctrl_c_ends_the_command_and_its_processes_and_keeps_the_parts(store: Path) -> None:
    process = begun(store)
    wait_until(lambda: links_in(store) >= 1)
    children = children_of(process.pid)

    os.kill(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)

    assert process.returncode == 130
    assert "Traceback" not in errors
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in children))
    assert links_in(store) >= 1


@pytest.fixture
def start_dask(tmp_path: Path) -> Iterator[Callable[..., str]]:
    """Return a function that starts ``dask scheduler`` with workers, and returns its address."""
    processes = []

    def run(*words: str) -> None:
        dask = [sys.executable, "-m", "dask", *words, "--no-dashboard", "--host", "127.0.0.1"]
        processes.append(subprocess.Popen(dask, cwd=tmp_path, stderr=subprocess.DEVNULL))

    def start(workers: int) -> str:
        file = tmp_path / "scheduler.json"
        run("scheduler", "--port", "0", "--scheduler-file", str(file))
        wait_until(lambda: file.exists() and bool(file.read_bytes()))
        address: str = json.loads(file.read_bytes())["address"]
        for _ in range(workers):
            run("worker", address, "--nthreads", "1", "--no-nanny")
        return address

    yield start
    for process in processes:
        process.kill()
        process.wait()


def test_a_dask_scheduler_that_runs_computes_the_parts(store: Path, start_dask: Callable[..., str]) -> None:
    process = begun(store, "--scheduler", start_dask(1))

    text, errors = process.communicate(timeout=100)

    assert process.returncode == 0, errors
    assert json.loads(text)["joined"] == ["a", "b"]
    assert json.loads(text)["parts"]["computed"] > 3


@pytest.mark.parametrize(
    ("address", "problem"),
    [
        ("127.0.0.1:1", "no Dask scheduler answered"),
        ("tls://127.0.0.1:1", "needs certificates"),
        ("", "has no worker"),
    ],
)
def test_a_scheduler_that_cannot_compute_is_one_line_with_a_hint(
    store: Path, start_dask: Callable[..., str], address: str, problem: str
) -> None:
    process = begun(store, "--scheduler", address or start_dask(0))
    _, errors = process.communicate(timeout=100)

    assert process.returncode in (1, 2)
    assert problem in errors
    assert (errors.count("\n"), errors.count("  hint: ")) == (2, 1), errors
