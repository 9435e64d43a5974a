"""A network namespace that stands for another machine: a pair of virtual interfaces leads to it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

SOON_S = 60.0


@dataclass(frozen=True)
class OtherMachine:
    """A namespace; ``here`` is the address of this machine as it sees it."""

    name: str
    here: str

    def run(self, *command: str, within_s: float = SOON_S) -> subprocess.CompletedProcess[str]:
        """Run *command* there."""
        return subprocess.run(
            ["ip", "netns", "exec", self.name, *command], capture_output=True, text=True, timeout=within_s,
            check=False, cwd=Path(__file__).parents[4],
        )  # fmt: skip

    def python(self, program: str, *words: str) -> str:
        """Run a Python program there; return what it printed, which must be all."""
        done = self.run(sys.executable, "-c", program, *words)
        assert (done.returncode, done.stderr) == (0, ""), done.stderr
        return done.stdout


def _ip(*words: str) -> bool:
    return subprocess.run(["ip", *words], capture_output=True, check=False).returncode == 0


@pytest.fixture(scope="module")
def other_machine() -> Iterator[OtherMachine]:
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("a network namespace needs root and ip(8)")
    number = os.getpid() % 200 + 20
    name, near, far = f"rse-pf-{number}", f"rsepf{number}a", f"rsepf{number}b"
    here, there = f"10.211.{number}.1", f"10.211.{number}.2"
    if not _ip("netns", "add", name):
        pytest.skip("the kernel makes no network namespace here")
    try:
        inside = ("-n", name)
        steps = (
            ("link", "add", near, "type", "veth", "peer", "name", far, "netns", name),
            ("address", "add", f"{here}/24", "dev", near),
            ("link", "set", near, "up"),
            (*inside, "address", "add", f"{there}/24", "dev", far),
            (*inside, "link", "set", far, "up"),
            (*inside, "link", "set", "lo", "up"),
        )
        if not all(_ip(*step) for step in steps):
            pytest.skip("the kernel makes no virtual interfaces here")
        yield OtherMachine(name, here)
    finally:
        _ip("netns", "delete", name)
        _ip("link", "delete", near)
