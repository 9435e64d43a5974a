"""One backend server in processes of its own, and what its process tree uses: shared by benchmarks of load.

It starts `rse-pf serve` with the settings that a benchmark names, on free ports of loopback, and measures
nothing by itself.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError
from rse_pf.processes.linux import raise_descriptor_limit

__all__ = ["UNLIMITED", "BenchServer", "cpu_of_tree_s", "private_bytes_of_tree", "resident_mib", "tree"]

UNLIMITED: dict[str, dict[str, Any]] = {
    "auth": {"required": False},
    "serving": {
        "max_robots": 20_000, "max_accepts_per_s": 0.0, "max_handshakes_per_source_per_s": 0.0,
        "max_unauthenticated": 2000, "max_unauthenticated_per_source": 0,
    },
    "session": {"max_commands_per_s": 0.0},
}  # fmt: skip
"""Settings without rate limits and tokens, for a benchmark that sends as many robots from one machine."""

_START_S = 30.0  # time limit for the start of the server
_KEY_BYTES = 32  # size of the seed of the signing key


def tree(pid: int) -> list[int]:
    """Return *pid* and the ids of all its living descendants."""
    family = [pid]
    for member in family:
        try:
            tasks = list(Path(f"/proc/{member}/task").iterdir())
            family += [int(child) for task in tasks for child in (task / "children").read_text().split()]
        except OSError:  # the process ended after it was listed
            continue
    return family


def cpu_of_tree_s(pid: int) -> float:
    """Return the user and system CPU seconds of *pid* and its descendants, also of those that have ended."""
    ticks = 0
    for child in tree(pid):
        try:
            fields = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        # Fields 11 and 12 are of the process itself, 13 and 14 of its children that have exited.
        ticks += sum(map(int, fields[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


def private_bytes_of_tree(pid: int) -> int:
    """Return the bytes of private memory of *pid* and its descendants: pages that one process alone uses."""
    kilobytes = 0
    for child in tree(pid):
        try:
            lines = Path(f"/proc/{child}/smaps_rollup").read_text().splitlines()
        except OSError:
            continue
        kilobytes += sum(int(line.split()[1]) for line in lines if line.startswith("Private_"))
    return 1024 * kilobytes


def resident_mib(pids: Sequence[int]) -> float:
    """Return the resident memory of *pids* and their descendants, MiB."""
    pages = 0
    for child in itertools.chain.from_iterable(map(tree, pids)):
        try:
            pages += int(Path(f"/proc/{child}/statm").read_text().split()[1])
        except OSError:
            continue
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


class BenchServer:
    """A server for one benchmark: ``with BenchServer(folder, workers=2) as server`` starts and stops it.

    *groups* are settings that replace the defaults, such as ``session={"max_in_flight": 4}``; `UNLIMITED` is
    an example.  With ``auth.required``, `token` returns tokens that the server accepts.
    """

    def __init__(self, folder: Path, *, workers: int, **groups: dict[str, Any]) -> None:
        self.settings = PlatformSettings.from_dict(groups)
        self.workers = workers
        self.port = self.control_port = self.pid = 0
        self._folder = folder
        self._groups = groups
        self._key = SigningKey.from_seed(os.urandom(_KEY_BYTES), "bench-1")
        self._issued = 0

    def __enter__(self) -> BenchServer:
        raise_descriptor_limit()
        document = {"context": {"rse-pf": self._groups}}
        announce = self._folder / "announce.json"
        announce.unlink(missing_ok=True)
        (self._folder / "settings.json").write_text(json.dumps(document), encoding="utf-8")
        command: list[str | Path] = [
            sys.executable, "-m", "rse_pf.cli.main", "serve", "--settings", self._folder / "settings.json",
            "--port", "0", "--control-port", "0", "--workers", str(self.workers), "--announce", announce,
        ]  # fmt: skip
        if self.settings.auth.required:
            keys = self._folder / "keys.json"
            keys.write_text(self._key.key_set().to_json(), encoding="utf-8")
            command += ["--keys", keys]
        with self.log_file.open("wb") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, cwd=self._folder)
        until = time.monotonic() + _START_S
        while not announce.exists():
            if time.monotonic() > until or self._process.poll() is not None:
                self._process.kill()
                self._process.wait()
                raise ConfigurationError(
                    f"the server did not start within {_START_S:g} s",
                    hint=self.log_file.read_text(encoding="utf-8", errors="replace")[-500:],
                )
            time.sleep(0.02)  # polls until the deadline
        announced = json.loads(announce.read_text(encoding="utf-8"))
        self.port, self.control_port = announced["port"], announced["control_port"]
        self.pid = self._process.pid
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.terminate()
        try:
            self._process.wait(20.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    @property
    def log_file(self) -> Path:
        """The path of the server's log."""
        return self._folder / "server.log"

    def token(self, robot: str, tenant: str = "default") -> str:
        """Return a new token for *robot* of *tenant*."""
        self._issued += 1
        identity = f"t-{self._issued}"
        return self._key.issue(
            robot, now=time.time(), token_id=identity, settings=self.settings.auth, tenant=tenant
        )
