"""Cost of the audit log for a handshake: servers with and without it, in turns.

    python -m benchmarks server.audit [--n 1500] [--only accepted|refused]

Three servers of one worker each: without a log, without a log again, with one.  In every round each gets
one handshake, in random order; the second server without a log shows how far equal servers differ.  From
connect to the end of the answer's head, milliseconds.  The bar, for tail and median: the log's difference is
within what two equal servers differ by, or its 95 % interval (bootstrap over rounds) holds zero.
"""

from __future__ import annotations

import base64
import json
import os
import random
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import percentile, spread
from rse_pf.audit.verify import check_folder
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.wire import SUBPROTOCOLS

KEY = SigningKey.from_seed(b"a" * 32, "bench-1")
SERVERS = ("off", "off again", "on")
KINDS = {"accepted": 101, "refused": 401}
QUANTILES = (50, 95, 99)
WARM_UP, RESAMPLES = 50, 1000
START_S = 60.0


@benchmark(
    Bar("kinds.*.within_noise", equals=True),
    Bar("chain_good", equals=True),
)
def run_benchmark(
    *, n: Annotated[int, "handshakes of each kind with each server"] = 1500,
    only: Annotated[str | None, "this kind alone", KINDS] = None,
) -> dict[str, Any]:  # fmt: skip
    """Measure both kinds in turns, and check the log."""
    with tempfile.TemporaryDirectory() as folder:
        servers = [Server(Path(folder) / name.replace(" ", "-"), name == "on") for name in SERVERS]
        try:
            kinds = {kind: judge(measure_ms(servers, kind, n)) for kind in ([only] if only else KINDS)}
        finally:
            for server in servers:
                server.stop()
        verdicts = check_folder(Path(folder) / "on" / "audit")
    return {
        "kinds": kinds, "entries": sum(verdict.entries for verdict in verdicts),
        "chain_good": not any(verdict.problem for verdict in verdicts),
    }  # fmt: skip


class Server:
    """One server process; its log has settings of its own in nothing but being there."""

    def __init__(self, folder: Path, has_log: bool) -> None:
        folder.mkdir(parents=True)
        unlimited = {"serving": {"max_handshakes_per_source_per_s": 0.0, "max_accepts_per_s": 0.0}}
        (folder / "settings.json").write_text(json.dumps({"context": {"rse-pf": unlimited}}))
        (folder / "keys.json").write_text(KEY.key_set().to_json())
        announce = folder / "announce.json"
        self._log = (folder / "server.log").open("wb")
        self._process = subprocess.Popen(
            [
                sys.executable, "-m", "rse_pf.cli.main", "serve", "--settings", str(folder / "settings.json"),
                "--keys", str(folder / "keys.json"), "--port", "0", "--control-port", "0", "--workers", "1",
                "--server-id", "bench", "--announce", str(announce),
                *(["--audit", str(folder / "audit")] if has_log else []),
            ],
            stdout=subprocess.DEVNULL, stderr=self._log,
        )  # fmt: skip
        end = time.monotonic() + START_S
        while not announce.exists():
            if self._process.poll() is not None or time.monotonic() > end:
                raise SystemExit((folder / "server.log").read_text()[-2000:])
            time.sleep(0.05)  # looks again, with a deadline: the file comes by rename
        self.port = int(json.loads(announce.read_text())["port"])

    def stop(self) -> None:
        """Let it write what it holds, and end it."""
        self._process.terminate()
        self._process.wait(30)
        self._log.close()


def measure_ms(servers: list[Server], kind: str, rounds: int) -> np.ndarray:
    """Return milliseconds, ``(rounds, servers)``."""
    draw, taken = random.Random(7), np.zeros((rounds, len(servers)))
    settings, now = PlatformSettings().auth, time.time()
    for number in range(-WARM_UP, rounds):
        token = KEY.issue(f"robot-{number}", now=now, token_id=f"t{number}", settings=settings)
        if kind == "refused":
            token = token[:-20] + token[-20:][::-1]
        for row in draw.sample(range(len(servers)), len(servers)):
            took_ms = handshake_ms(servers[row].port, token, KINDS[kind])
            if number >= 0:
                taken[number, row] = took_ms
    return taken


def handshake_ms(port: int, token: str, expected: int) -> float:
    """Return how long one handshake took; its socket is closed without a word."""
    nonce = base64.b64encode(os.urandom(16)).decode()
    head = (
        "GET /ws HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {nonce}\r\n"
        f"Sec-WebSocket-Protocol: {SUBPROTOCOLS['bin']}\r\nAuthorization: Bearer {token}\r\n\r\n"
    ).encode()
    began = time.perf_counter()
    with socket.create_connection(("127.0.0.1", port), timeout=30) as link:
        link.sendall(head)
        answer = b""
        while b"\r\n\r\n" not in answer:
            piece = link.recv(4096)
            if not piece:
                raise SystemExit(f"the server hung up: {answer[:200]!r}")
            answer += piece
        took_s = time.perf_counter() - began
    if int(answer.split(b" ", 2)[1]) != expected:
        raise SystemExit(f"expected {expected}: {answer[:200]!r}")
    return took_s * 1e3


def judge(taken: np.ndarray) -> dict[str, Any]:
    """Return quantiles, what the log adds to each, and whether that is within the noise."""
    figures: dict[str, Any] = {name: spread(taken[:, row]) for row, name in enumerate(SERVERS)}
    rng, adds, noise = np.random.default_rng(11), [], []
    for _ in range(RESAMPLES):
        off, again, on = percentile(taken[rng.integers(0, len(taken), len(taken))], QUANTILES, axis=0).T
        adds.append(on - (off + again) / 2)
        noise.append(again - off)
    low, high = percentile(adds, (2.5, 97.5), axis=0)
    apart = np.abs(percentile(noise, (2.5, 97.5), axis=0)).max(axis=0)
    figures["log_adds_ms"] = np.median(adds, axis=0).round(3).tolist()
    figures["log_adds_95_ms"] = [low.round(3).tolist(), high.round(3).tolist()]
    figures["equal_servers_differ_ms"] = apart.round(3).tolist()
    is_within = (low <= 0) | (np.abs(np.median(adds, axis=0)) <= apart)
    figures["within_noise_of_each"] = is_within.tolist()
    figures["within_noise"] = bool(is_within[0] and is_within[-1])
    return figures
