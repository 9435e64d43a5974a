"""A real backend server with access control, as an operator runs it: keys, roster and deny-list in a folder.

Handshakes are written by hand, so that a test sees each byte of the answer.  The server listens on loopback
only, and every process of it has ended when the ``with`` block ends.
"""

from __future__ import annotations

import asyncio
import base64
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any

from rse_pf.auth.tokens import SigningKey
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.config import PlatformSettings
from rse_pf.storage.object_store import DirectoryStore
from rse_pf.wire import SUBPROTOCOLS

__all__ = ["KEY", "GuardedServer"]

KEY = SigningKey.from_seed(b"g" * 32, "guard-1")
_START_S = 60.0
_UNLIMITED: dict[str, Any] = {"serving": {"max_handshakes_per_source_per_s": 0.0, "max_accepts_per_s": 0.0}}


class GuardedServer:
    """``with GuardedServer(folder) as server``; `restart` keeps the folder and takes a new port."""

    def __init__(self, folder: Path, *, workers: int = 2, **groups: dict[str, Any]) -> None:
        self.folder = folder
        self.settings = PlatformSettings.from_dict({**_UNLIMITED, **groups})
        self.access = AccessControlStore(DirectoryStore(folder))
        self.port = 0
        self._workers = workers
        self._process: subprocess.Popen[bytes] | None = None
        self._issued = 0
        document = {"context": {"rse-pf": {**_UNLIMITED, **groups}}}
        (folder / "settings.json").write_text(json.dumps(document))
        (folder / "keys.json").write_text(KEY.key_set().to_json())

    def __enter__(self) -> GuardedServer:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def url(self) -> str:
        """Where robots connect."""
        return f"ws://127.0.0.1:{self.port}/ws"

    @property
    def log(self) -> str:
        """Everything the server wrote."""
        return (self.folder / "server.log").read_text()

    def start(self, port: int = 0) -> None:
        """Start it, on a free port or on *port*, and wait until it announces itself."""
        announce = self.folder / "announce.json"
        announce.unlink(missing_ok=True)
        with (self.folder / "server.log").open("ab") as log:
            self._process = subprocess.Popen(
                [
                    sys.executable, "-m", "rse_pf.cli.main", "serve", "--settings",
                    str(self.folder / "settings.json"), "--keys", str(self.folder / "keys.json"),
                    "--port", str(port), "--control-port", "0", "--workers", str(self._workers),
                    "--server-id", "guarded", "--announce", str(announce),
                    "--audit", str(self.folder / "audit"),
                ],
                stdout=subprocess.DEVNULL, stderr=log, cwd=self.folder,
            )  # fmt: skip
        end = time.monotonic() + _START_S
        while not announce.exists():
            assert self._process.poll() is None, self.log
            assert time.monotonic() < end, self.log
            os.sched_yield()
        self.port = json.loads(announce.read_text())["port"]

    def stop(self) -> None:
        """End it at once."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def drain(self) -> None:
        """Let it drain and exit by itself, as an operator does: its recording is then complete."""
        assert self._process is not None
        self._process.terminate()
        self._process.wait(_START_S)
        self._process = None

    def restart(self, port: int = 0) -> None:
        """Kill it and start it again on the same folder."""
        self.stop()
        self.start(port)

    def token(self, robot: str, **more: Any) -> str:
        """Return a token of the platform that was never issued before."""
        self._issued += 1
        token_id = f"t-{self._issued}"
        return KEY.issue(robot, now=time.time(), token_id=token_id, settings=self.settings.auth, **more)

    async def handshake(self, authorization: bytes) -> tuple[int, bytes]:
        """Return status and body of a handshake with this header; (0, b"") if the server just hung up."""
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
        try:
            nonce = base64.b64encode(os.urandom(16))
            writer.write(
                b"GET /ws HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: " + nonce + b"\r\n"
                b"Sec-WebSocket-Protocol: " + SUBPROTOCOLS["bin"].encode() + b"\r\n"
                b"Authorization: " + authorization + b"\r\n\r\n"
            )
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), 30)
            status = int(head.split(b" ", 2)[1])
            body = await asyncio.wait_for(reader.read(), 30) if status != 101 else b""
            return status, body
        except (asyncio.IncompleteReadError, ConnectionError):
            return 0, b""
        finally:
            writer.transport.abort()
