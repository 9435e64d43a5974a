"""Kill a data service at each step of a PUT and of an upload in parts: acknowledged objects must be whole.

    python -m benchmarks data.kills [--kills 500] [--seed 1]

A data service, forked from this process, sends itself SIGKILL at one of the system calls that change the
store: before the call, after it, or in the middle of a write.  The next service starts in the same folder.
All objects of the store are read after every tenth kill and after the last two.

Defends the promise that an acknowledged object is in the store and whole after kill -9, and that no partial
object is visible.
"""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import json
import os
import random
import signal
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.frame.registry import Bar, benchmark
from rse_pf.auth.tokens import SigningKey
from rse_pf.config import AuthSettings, PlatformSettings
from rse_pf.data_server.routes import openapi_page
from rse_pf.data_server.server import KeysFile, serve_data
from rse_pf.storage.object_store import DirectoryStore

ROOT = Path(__file__).resolve().parents[2]
# Key that signs the tokens of the robot.
KEY = SigningKey.from_seed(b"k" * 32, "key-1")
CALLS = (
    "open", "write", "pwrite", "fsync", "replace", "rename", "mkdir", "close", "unlink", "rmdir", "ftruncate",
)  # fmt: skip
"""Functions of `os` at which a service may be killed."""
LAST_CALL = 90  # a service is killed at one of its first 89 calls
PUTS = 4  # objects that are sent whole before each upload in parts
PART_BYTES = 100_000  # size of each part of an upload
TIMEOUT_S = 30.0  # longest wait for an answer of the service, and for its start


def die_at(number: int, place: int) -> None:
    """Kill this process at system call *number* of its data threads.

    *place* is 0 for before the call, 1 for after the call, and 2 for within the call.
    """
    calls = [0]

    def patched(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any, **named: Any) -> Any:
            if threading.current_thread().name != "data":
                return call(*arguments, **named)
            calls[0] += 1
            is_last = calls[0] == number
            if is_last and place == 2 and name in ("write", "pwrite"):
                handle, data, *rest = arguments
                call(handle, data[: len(data) // 2], *rest)
            if is_last and place != 1:
                die(name)
            try:
                return call(*arguments, **named)
            finally:
                if is_last:
                    die(name)

        return run

    def die(name: str) -> None:
        os.write(2, f"killed {('before', 'after', 'within')[place]} {name}\n".encode())
        os.kill(os.getpid(), signal.SIGKILL)

    for name in CALLS:
        setattr(os, name, patched(name, getattr(os, name)))


def serve(folder: Path, number: int, place: int) -> None:
    """Serve in this forked process until the process kills itself."""
    log = os.open(folder / "log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 2)
    die_at(number, place)
    serve_data(
        PlatformSettings().replace(data={"port": 0}), DirectoryStore(folder / "objects"),
        keys=KeysFile(folder / "keys.json"), announce=folder / "announce.json", audit=folder / "audit",
    )  # fmt: skip


def send(port: int, robot: str, source: random.Random) -> Iterator[tuple[str, bool]]:
    """Send objects; yield each digest with False before it is sent, and with True once it is acknowledged."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=TIMEOUT_S)
    bearer = KEY.issue(robot, now=time.time(), token_id="t", settings=AuthSettings())
    token = {"Authorization": f"Bearer {bearer}"}

    def ask(method: str, path: str, body: bytes, **headers: str) -> int:
        connection.request(method, path, body, token | headers)
        answer = connection.getresponse()
        answer.read()
        return answer.status

    while True:
        for _ in range(PUTS):
            data = source.randbytes(source.choice((1, 4096, 70_000)))
            digest = hashlib.sha256(data).hexdigest()
            yield digest, False
            if ask("PUT", f"/data/v1/objects/{digest}", data) in (200, 201):
                yield digest, True
        data = source.randbytes(3 * PART_BYTES)
        digest = hashlib.sha256(data).hexdigest()
        path = f"/data/v1/uploads/{digest}"
        yield digest, False
        ask("PUT", path, json.dumps({"size": len(data)}).encode())
        for offset in range(0, len(data), PART_BYTES):
            part = data[offset : offset + PART_BYTES]
            status = ask("PATCH", path, part, **{"Upload-Offset": str(offset)})
        if status == 201:
            yield digest, True


def check(folder: Path, sent: set[str], acknowledged: set[str]) -> list[str]:
    """Return a sentence for each object with other bytes than were sent, and for each that is lost."""
    store, seen, wrong = DirectoryStore(folder / "objects"), set(), []
    for info in store.list("objects/"):
        digest = info.name.rpartition("/")[2]
        seen.add(digest)
        if digest not in sent or hashlib.sha256(store.get(info.name)).hexdigest() != digest:
            wrong.append(f"{info.name} is not what was sent")
    return wrong + [f"{digest} was acknowledged and is lost" for digest in acknowledged - seen]


@benchmark(Bar("wrong", equals=[]))
def run_benchmark(*, kills: int = 500, seed: int = 1) -> dict[str, Any]:
    """Kill *kills* services, one after the other, and check the objects of the store."""
    source, sent, acknowledged = random.Random(seed), set[str](), set[str]()
    wrong: list[str] = []
    (ROOT / "build").mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=ROOT / "build") as made:
        folder = Path(made)
        (folder / "keys.json").write_text(KEY.key_set().to_json())
        openapi_page()  # made once here, and not in each forked service
        for kill in range(kills):
            announcement = folder / "announce.json"
            announcement.unlink(missing_ok=True)
            child = os.fork()
            if not child:
                try:
                    serve(folder, source.randrange(1, LAST_CALL), kill % 3)
                finally:  # the forked process does not return to the caller, which would remove the folder
                    traceback.print_exc()
                    os._exit(1)
            source.random()
            until = time.monotonic() + TIMEOUT_S
            while not announcement.exists() and time.monotonic() < until:
                time.sleep(0.002)  # polls, with a deadline
            port = json.loads(announcement.read_text())["port"]
            with contextlib.suppress(OSError, http.client.HTTPException):
                for digest, is_acknowledged in send(port, f"robot-{kill % 7}", source):
                    (acknowledged if is_acknowledged else sent).add(digest)
            assert os.waitpid(child, 0)[1] == signal.SIGKILL, "the service ended in another way"
            if kill % 10 == 9 or kill > kills - 3:
                wrong = check(folder, sent, acknowledged)
            if wrong:
                break
        places = Counter(line for line in (folder / "log").read_text().splitlines() if "killed" in line)
    return {
        "n": kills, "sent": len(sent), "acknowledged": len(acknowledged), "wrong": wrong, "places": places
    }  # fmt: skip
