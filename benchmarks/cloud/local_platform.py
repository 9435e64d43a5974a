"""A local platform of its own for a benchmark: started and stopped by the commands that users type."""

from __future__ import annotations

import json
import os
import secrets
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.local.firewall import ensure_key, key_file, read_key
from rse_pf.local.state import state_folder

__all__ = ["LocalPlatform"]

_START_S = 180.0
_COMMAND = [sys.executable, "-m", "rse_pf.cli.main"]


class LocalPlatform:
    """``rse-pf local`` under *name*, with files of its own in *folder*; use it with ``with``."""

    def __init__(self, name: str, folder: Path, *, servers: int = 2, seed: bytes | None = None) -> None:
        """Describe it; platforms with the same *seed* (32 bytes) accept the tokens of each other."""
        self.name, self.servers = name, servers
        self._seed = seed
        self.folder = folder
        self.port = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._environment = {**os.environ, "XDG_STATE_HOME": str(folder / "state")}

    def __enter__(self) -> LocalPlatform:
        """Start it and wait until all its servers are ready."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if self._seed is not None:
            state_of_mine = state_folder(self.name, self._environment)
            state_of_mine.mkdir(mode=0o700, parents=True, exist_ok=True)
            ensure_key(state_of_mine, seed=self._seed, key_id="bench")
        with (self.folder / f"{self.name}.log").open("wb") as log:
            self._process = subprocess.Popen(
                [
                    *_COMMAND, "local", "start", "--name", self.name, "--port", "0", "--metrics-port", "0",
                    "--no-page", "--no-data", "--servers", str(self.servers),
                ],
                stdout=log, stderr=log, env=self._environment, cwd=self.folder,
            )  # fmt: skip
        until = time.monotonic() + _START_S
        while time.monotonic() < until and self._process.poll() is None:
            state = self._state()
            ready = [server for server in state.get("servers", []) if server["state"] == "ready"]
            if len(ready) >= self.servers:
                self.port = int(state["balancer"]["port"])
                return self
            time.sleep(0.5)  # polls, with a deadline
        log_text = (self.folder / f"{self.name}.log").read_text(encoding="utf-8", errors="replace")
        self.__exit__(None, None, None)
        raise SystemExit(f"the platform did not start:\n{log_text[-2000:]}")

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop it."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait(60)

    def kill(self) -> None:
        """End all its processes by SIGKILL, the one that would replace them first."""
        state = self._state()
        boxes = [state["control_plane"], state["balancer"], *state["servers"]]
        for box in boxes:
            os.kill(int(box["pid"]), signal.SIGKILL)
        assert self._process is not None
        self._process.wait(60)

    def robot(self, action: str, name: str, *options: str) -> None:
        """Run ``rse-pf robot`` for this platform."""
        subprocess.run(
            [*_COMMAND, "robot", action, name, "--name", self.name, *options],
            check=True, capture_output=True, env=self._environment, cwd=self.folder,
        )  # fmt: skip

    def token(self, robot: str) -> str:
        """Return a token of this platform for *robot*."""
        key = read_key(key_file(state_folder(self.name, self._environment)))
        auth = PlatformSettings().auth
        return key.issue(robot, now=time.time(), token_id=secrets.token_hex(8), settings=auth)

    def _state(self) -> dict[str, Any]:
        done = subprocess.run(
            [*_COMMAND, "local", "status", "--name", self.name, "--json"],
            capture_output=True, env=self._environment, cwd=self.folder, check=False,
        )  # fmt: skip
        try:
            state: dict[str, Any] = json.loads(done.stdout)
        except ValueError:
            return {}
        return state
