"""CPU of one handshake on a server, accepted and refused, for all processes of the server.

    python -m benchmarks server.handshakes [--base TREE] [--n 1000] [--at-once 1] [--only WORDS]

An accepted handshake is connect, upgrade, Hello, Welcome and close; a refused one ends with its HTTP answer.
The rows differ in the token: none is required, signed by the platform, signed by an enrolled robot's key (a
new token for each handshake, or always the same one), none, another key's, expired; wrong path; a robot that
is banned.  CPU is read from the kernel's clocks of supervisor and workers, for batches of 50 handshakes; the
percentiles are those of the batches.  With ``--base`` a server of another tree is measured, in turns.
Defends: <= 400 us accepted and refused (1,340 to 1,550 in version 0.1.0).
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated, Any

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.statistics import spread
from rse_pf.auth.roster import EnrolledRobot
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import AuthSettings
from rse_pf.wire import SUBPROTOCOLS, Hello, make_codec

BATCH = 50
BAR_US = 400
WAIT_S = 10.0
CODEC = "bin"
PLATFORM_SEED, ROBOT_SEED, STRANGER_SEED = (bytes([number]) * 32 for number in (1, 2, 3))

SERVE = """
import json, sys
from pathlib import Path
from rse_pf.auth.roster import DenyList, Roster, from_json
from rse_pf.auth.tokens import KeySet
from rse_pf.backend.supervisor import serve
from rse_pf.config import PlatformSettings
told = json.loads(sys.argv[1])
keys = None
if told["keys"]:
    keys = KeySet.from_json(told["keys"]).with_access_control(from_json(told["robots"], Roster), DenyList())
sys.exit(serve(PlatformSettings.from_dict(told["settings"]), keys=keys, server_id="bench",
               announce=Path(told["announce"]), audit=Path(told["audit"]) if told["audit"] else None))
"""
UNLIMITED = {
    "max_accepts_per_s": 1e6, "max_handshakes_per_source_per_s": 1e6,
    "max_unauthenticated_per_source": 0, "max_robots": 100_000,
}  # fmt: skip
"""Limits that are counted, but never reached."""


def settings_of(workers: int, *, tokens: bool, **session: float) -> dict[str, Any]:
    """Return the settings of a server, as a document; *session* is added to the group of that name."""
    return {
        "serving": {"port": 0, "control_port": 0, "workers": workers, "trusted_proxies": 0, **UNLIMITED},
        "auth": {"required": tokens},
        "session": {"rate_ban_s": 3600.0, **session},
    }


class Server:
    """A running server of one tree."""

    def __init__(self, identity: dict[str, Any]) -> None:
        self.address = ("127.0.0.1", int(identity["port"]))
        self.pids = [identity["pid"], *identity["workers"]]
        self._control_port = identity["control_port"]
        # The kernel's clock of another process, in nanoseconds: CPUCLOCK_SCHED of its pid.
        self._clocks = [~pid << 3 | 2 for pid in self.pids]

    def cpu_s(self) -> float:
        """Return the CPU seconds of all processes."""
        return sum(map(time.clock_gettime, self._clocks))

    def status(self) -> dict[str, Any]:
        """Return the server's own numbers."""
        with urllib.request.urlopen(f"http://127.0.0.1:{self._control_port}/status") as answer:
            document: dict[str, Any] = json.loads(answer.read())
        return document


@contextmanager
def serve_tree(
    tree: Path | None, workers: int, *, tokens: bool, audit: bool, **session: float
) -> Iterator[Server]:
    """Start a server of *tree* (None: this one), and end it."""
    with tempfile.TemporaryDirectory() as folder:
        announce = Path(folder) / "announce.json"
        enrolled = EnrolledRobot(robot="enrolled", x=_x_of(SigningKey.of_robot(ROBOT_SEED)))
        placement = {
            "announce": str(announce),
            "audit": str(Path(folder) / "audit") if audit else "",
            "settings": settings_of(workers, tokens=tokens, **session),
            "keys": SigningKey.from_seed(PLATFORM_SEED, "platform").key_set().to_json() if tokens else "",
            "robots": json.dumps({"robots": [{"robot": enrolled.robot, "x": enrolled.x}]}),
        }
        environment = {**os.environ, **({} if tree is None else {"PYTHONPATH": str(tree)})}
        with (Path(folder) / "server.log").open("wb") as log:
            process = subprocess.Popen(
                [sys.executable, "-c", SERVE, json.dumps(placement)],
                stdout=log, stderr=log, env=environment, cwd=tree or Path.cwd(),
            )  # fmt: skip
        try:
            deadline = time.monotonic() + 30
            while not announce.exists():
                if time.monotonic() > deadline or process.poll() is not None:
                    raise SystemExit((Path(folder) / "server.log").read_text()[-2000:])
                time.sleep(0.02)  # looks again, with a deadline
            yield Server(json.loads(announce.read_text()))
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(20)


def _x_of(key: SigningKey) -> str:
    return str(json.loads(key.public_json())["x"])


def mask_frame(opcode: int, payload: bytes) -> bytes:
    """Return one frame of a client, with the mask 0."""
    assert len(payload) < 126
    return bytes([0x80 | opcode, 0x80 | len(payload)]) + bytes(4) + payload


HELLO = mask_frame(2, make_codec(CODEC).encode(Hello()))
BAD_MESSAGES = mask_frame(2, b"?") * 16
CLOSE = mask_frame(8, (1000).to_bytes(2, "big"))


def request(address: tuple[str, int], token: str, path: str = "/ws") -> bytes:
    """Return the head of a handshake as a robot sends it through a load balancer."""
    bearer = f"Authorization: Bearer {token}\r\n" if token else ""
    return (
        f"GET {path} HTTP/1.1\r\nHost: {address[0]}:{address[1]}\r\nUpgrade: websocket\r\n"
        "Connection: Upgrade\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Protocol: {SUBPROTOCOLS[CODEC]}\r\n{bearer}"
        "User-Agent: Python/3.11 websockets/15.0\r\n\r\n"
    ).encode()


class Client:
    """A socket of a robot, without the cost of a library."""

    def __init__(self, address: tuple[str, int], source: str = "127.0.0.1") -> None:
        self._socket = socket.create_connection(address, timeout=WAIT_S, source_address=(source, 0))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._seen = b""

    def send(self, data: bytes) -> None:
        """Send *data*."""
        self._socket.sendall(data)

    def head(self) -> bytes:
        """Return the status line of the answer; what follows its head stays."""
        while b"\r\n\r\n" not in self._seen:
            more = self._socket.recv(4096)
            if not more:
                raise SystemExit(f"the server closed the connection: {self._seen!r}")
            self._seen += more
        head, _, self._seen = self._seen.partition(b"\r\n\r\n")
        return head.partition(b"\r\n")[0]

    def frame(self) -> None:
        """Wait for one short frame."""
        while len(self._seen) < 2 or len(self._seen) < 2 + self._seen[1]:
            more = self._socket.recv(4096)
            if not more:
                raise SystemExit("the server closed the connection")
            self._seen += more

    def end(self) -> None:
        """Wait until the server closed the connection, and close it."""
        while self._socket.recv(4096):
            pass
        self._socket.close()


def make_batch(server: Server, heads: list[bytes], status: bytes) -> None:
    """Shake hands with all of *heads* at once, and end the connections."""
    clients = [Client(server.address) for _ in heads]
    for client, head in zip(clients, heads, strict=True):
        client.send(head)
    is_accepted = status == b"101"
    for client in clients:
        answer_head = client.head()
        if status not in answer_head:
            raise SystemExit(f"wanted {status!r}, got {answer_head!r}")
        if is_accepted:
            client.send(HELLO)
    for client in clients:
        if is_accepted:
            client.frame()
            client.send(CLOSE)
    for client in clients:
        client.end()


def ban(server: Server, token: str) -> None:
    """Get the robot of *token* banned in every worker, by messages that nobody understands."""
    for _ in range(64):
        client = Client(server.address)
        client.send(request(server.address, token))
        if b"101" in client.head():
            client.send(HELLO)
            client.frame()
            client.send(BAD_MESSAGES)
        client.end()


Heads = Callable[[tuple[str, int]], bytes]


def rows() -> list[tuple[str, bool, bytes, Callable[[], Heads]]]:
    """Return name, whether tokens are required, expected status, and what makes the next request."""
    numbers, settings, now = itertools.count(), AuthSettings(), time.time()
    keys = {
        "platform": (SigningKey.from_seed(PLATFORM_SEED, "platform"), "plain"),
        "robot": (SigningKey.of_robot(ROBOT_SEED), "enrolled"),
        "stranger": (SigningKey.from_seed(STRANGER_SEED, "platform"), "plain"),
    }

    def token(signer: str, issued_s: float = now, name: str = "") -> str:
        key, robot = keys[signer]
        return key.issue(name or robot, now=issued_s, token_id=f"t{next(numbers)}", settings=settings)

    def fresh(signer: str, issued_s: float = now) -> Callable[[], Heads]:
        return lambda: lambda address: request(address, token(signer, issued_s))

    def same(signer: str, name: str = "") -> Callable[[], Heads]:
        signed = token(signer, name=name)
        return lambda: lambda address: request(address, signed)

    def plain(path: str) -> Callable[[], Heads]:
        return lambda: lambda address: request(address, "", path)

    return [
        ("accepted, no token required", False, b"101", plain("/ws")),
        ("accepted, platform, new token", True, b"101", fresh("platform")),
        ("accepted, platform, same token", True, b"101", same("platform")),
        ("accepted, robot key, new token", True, b"101", fresh("robot")),
        ("accepted, robot key, same token", True, b"101", same("robot")),
        ("refused, no token", True, b"401", plain("/ws")),
        ("refused, another key's token", True, b"401", fresh("stranger")),
        ("refused, expired", True, b"401", fresh("platform", now - 100_000.0)),
        ("refused, wrong path", True, b"404", plain("/other")),
        ("refused, banned", True, b"429", same("platform", "banned")),
    ]


def measure(servers: dict[str, dict[bool, Server]], n: int, at_once: int, only: str) -> dict[str, Any]:
    """Return for each row and tree the CPU of one handshake in microseconds."""
    figures: dict[str, Any] = {}
    for name, tokens, status, make in rows():
        if only not in name:
            continue
        taken: dict[str, list[float]] = {tree: [] for tree in servers}
        make_head = make()
        for number in range(-1, n // BATCH):
            for tree in servers if number % 2 else reversed(servers):
                server = servers[tree][tokens]
                if number < 0 and "banned" in name:
                    ban(server, make_head(server.address).decode().partition("Bearer ")[2].split("\r\n")[0])
                heads = [make_head(server.address) for _ in range(BATCH)]
                before = wait_settled(server)
                for first in range(0, BATCH, at_once):
                    make_batch(server, heads[first : first + at_once], status)
                if number >= 0:
                    taken[tree].append((wait_settled(server) - before) / BATCH * 1e6)
        figures[name] = {tree: spread(batches) for tree, batches in taken.items()}
    return figures


def wait_settled(server: Server) -> float:
    """Return the CPU seconds of *server* once it does nothing more."""
    before, deadline = -1.0, time.monotonic() + WAIT_S
    while before != (now := server.cpu_s()) and time.monotonic() < deadline:
        before = now
        time.sleep(0.004)  # looks again, with a deadline
    return now


@benchmark(Bar("*.this tree.p50", at_most=BAR_US, unit="us of CPU"))
def run_benchmark(
    *,
    base: Annotated[Path | None, "another tree of the sources, measured in turns"] = None,
    n: Annotated[int, "handshakes of each row"] = 1000,
    at_once: Annotated[int, "handshakes that robots begin together"] = 1,
    only: Annotated[str, "measure the rows with these words in their name"] = "",
    workers: int = 2,
    audit: Annotated[bool, "record the handshakes in an audit log"] = False,
) -> dict[str, Any]:
    """Measure all rows, with two trees in turns."""
    trees = {**({"base": base.resolve()} if base else {}), "this tree": None}
    with ExitStack() as stack:
        servers = {
            name: {
                tokens: stack.enter_context(serve_tree(tree, workers, tokens=tokens, audit=audit))
                for tokens in (False, True)
            }
            for name, tree in trees.items()
        }
        return measure(servers, n, at_once, only)
