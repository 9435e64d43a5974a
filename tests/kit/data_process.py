"""A data service as `rse-pf data` runs it, in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from rse_pf.auth.tokens import SigningKey
from rse_pf.config import AuthSettings

KEY = SigningKey.from_seed(b"k" * 32, "key-1")
START_S = 30.0


class DataProcess:
    """The process with its *port*; a context manager.  *data* are settings of the group of that name."""

    def __init__(self, folder: Path, **data: Any) -> None:
        self._folder, self._data = folder, data

    def __enter__(self) -> DataProcess:
        folder = self._folder
        keys, settings, announce = (folder / f"{name}.json" for name in ("keys", "settings", "announce"))
        keys.write_text(KEY.key_set().to_json())
        settings.write_text(json.dumps({"context": {"rse-pf": {"data": self._data}}}))
        command = [
            sys.executable, "-m", "rse_pf.cli.main", "data", "--settings", str(settings), "--keys", str(keys),
            "--port", "0", "--store", f"dir:{folder / 'objects'}", "--announce", str(announce),
        ]  # fmt: skip
        with (folder / "data.log").open("wb") as log:
            self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=log)
        end = time.monotonic() + START_S
        while not announce.exists():  # polls, with a deadline
            assert self._process.poll() is None, (folder / "data.log").read_text()
            assert time.monotonic() < end
            time.sleep(0.01)
        self.port = int(json.loads(announce.read_text())["port"])
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()

    def token(self, robot: str, tenant: str = "default") -> str:
        """Return a token of *robot*."""
        return KEY.issue(robot, now=time.time(), token_id="t", settings=AuthSettings(), tenant=tenant)

    def peak_memory_mib(self) -> float:
        """Return the most memory that the process has had resident."""
        lines = Path(f"/proc/{self._process.pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1024
