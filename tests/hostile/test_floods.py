"""Floods against a real server: refused or cut off at the limit, counted, and others are served meanwhile."""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import re
import time
import urllib.request
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from client_sdk import connect
from rse_pf.wire import Command, Result
from tests.kit import attacks
from tests.kit.attacks import AttackTarget, Outcome
from tests.kit.guarded_server import GuardedServer

pytestmark = pytest.mark.system

ONE_S = 1.0
SOON_S = 10.0
_NUMBERS = itertools.count()
"""Every attacker is a robot of its own: one that was cut off rests."""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GuardedServer]:
    """One worker with short timeouts, where sockets come directly and from one address."""
    groups: dict[str, dict[str, Any]] = {
        "serving": {
            "slow_reader_timeout_s": 0.3,
            "trusted_proxies": 0, "max_unauthenticated_per_source": 20, "max_unauthenticated": 40,
            "max_handshakes_per_source_per_s": 0.0, "max_accepts_per_s": 0.0,
        },
        "session": {"hello_timeout_s": ONE_S},
    }  # fmt: skip
    with GuardedServer(tmp_path_factory.mktemp("floods"), workers=1, **groups) as made:
        yield made


def announced(server: GuardedServer) -> dict[str, Any]:
    told: dict[str, Any] = json.loads((server.folder / "announce.json").read_text())
    return told


def resident_mib(server: GuardedServer) -> float:
    told = announced(server)
    pages = [
        int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in (told["pid"], *told["workers"])
    ]
    return sum(pages) * os.sysconf("SC_PAGE_SIZE") / 2**20


def counted(server: GuardedServer, name: str, label: str, at_least: float) -> bool:
    """Return whether a counter of /metrics, which is renewed four times a second, comes to *at_least*."""
    url, end = f"http://127.0.0.1:{announced(server)['control_port']}/metrics", time.monotonic() + SOON_S
    while time.monotonic() < end:
        with urllib.request.urlopen(url, timeout=SOON_S) as answer:
            text = answer.read().decode()
        found = re.search(rf'rse_pf_{name}_total{{[a-z]+="{label}"}} ([0-9.e+]+)', text)
        if found and float(found[1]) >= at_least:
            return True
    return False


def attacked(
    server: GuardedServer, attack: Callable[[AttackTarget], Awaitable[Outcome]], *, robots: int = 1
) -> tuple[Outcome, int]:
    """Return what came of *attack*, and how many calls of a robot beside it were answered, of 5."""
    tokens = tuple(server.token(f"hostile-{next(_NUMBERS)}") for _ in range(robots))

    async def run() -> tuple[Outcome, int]:
        target, answered = AttackTarget(server.url, tokens), 0
        async with connect(server.url, token=server.token("calm")) as calm:
            attacking = asyncio.ensure_future(attack(target))
            for _ in range(5):
                answer = await calm.call("echo", {"value": 1}, deadline_s=20.0)
                answered += answer.reply["value"] == 1
                await asyncio.wait({attacking}, timeout=0.1)
            outcome = await attacking
            assert calm.stats.reconnects == 0
        return outcome, answered

    return asyncio.run(run())


@pytest.mark.parametrize(
    ("attack", "code"), [(attacks.empty_fragments, "1009"), (attacks.ping_flood, "1008")]
)
def test_endless_frames_are_cut_off_at_the_limit(server, attack, code):
    outcome, answered = attacked(server, attack)

    assert outcome.ends == {code: 1}
    assert answered == 5
    assert counted(server, "closed", f"frames-{code}", 1)


def test_a_robot_at_a_hundred_times_its_rate_is_refused_cut_off_and_banned(server):
    async def attack(target: AttackTarget) -> Outcome:
        return await attacks.rate_flood(target, 2000.0, 1.5)

    outcome, answered = attacked(server, attack)

    assert outcome.ends["4429"] == 1
    assert outcome.ends["429"] >= 1, "it came back at once"
    assert outcome.refused > 50
    assert answered == 5
    assert counted(server, "shed", "rate", 100)
    assert counted(server, "handshakes", "quota", 1)


def test_every_bomb_is_refused_and_memory_stays(server):
    async def attack(target: AttackTarget) -> Outcome:
        return await attacks.zip_bombs(target, 100)

    attacks.bomb()  # takes a second, in which the robot beside it could not say a word
    before = resident_mib(server)
    outcome, answered = attacked(server, attack, robots=10)

    assert (outcome.tried, outcome.refused) == (100, 100)
    assert answered == 5
    assert resident_mib(server) - before < 64


_SIZE = (1 << 20) - 20_000  # bytes of a document, which leave room for the rest of a message of 1 MiB


def repeated(begin: bytes, item: bytes, end: bytes) -> bytes:
    """Return a document of *item*, separated by commas."""
    return begin + b",".join([item] * (_SIZE // (len(item) + 1))) + end


LARGE_DOCUMENTS = (
    b"[" * (_SIZE // 2) + b"]" * (_SIZE // 2),
    b'{"a":' * (_SIZE // 6) + b"1" + b"}" * (_SIZE // 6),
    repeated(b"{", b'"a":1', b"}"),
    repeated(b"[", b"1", b"]"),
    repeated(b"[", b"[]", b"]"),
    repeated(b"[", b"{}", b"]"),
    repeated(b"[", b'"ab"', b"]"),
    repeated(b"[", b"17976931348623157081e289", b"]"),
    b'["' + b'\\"' * (_SIZE // 2) + b'"]',
    b'["' + "\u00e9".encode() * (_SIZE // 2) + b'"]',
    b"[" + b",".join([b"0.12345678901234567"] * 28_000) + b"]",  # is read, and then refused by the service
)


def peak_mib(server: GuardedServer) -> float:
    """Return the largest resident memory of a worker since `forget_peaks`."""
    statuses = [Path(f"/proc/{pid}/status").read_text() for pid in announced(server)["workers"]]
    return max(int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0]) for status in statuses) / 1024


def forget_peaks(server: GuardedServer) -> None:
    for pid in announced(server)["workers"]:
        Path(f"/proc/{pid}/clear_refs").write_text("5")


def test_a_hundred_robots_with_documents_of_one_mib_take_little_memory_of_a_worker(server):
    async def attack(target: AttackTarget) -> Outcome:
        return await attacks.large_documents(target, LARGE_DOCUMENTS)

    forget_peaks(server)
    before = peak_mib(server)
    outcome, answered = attacked(server, attack, robots=100)

    assert outcome.ends.keys() <= {"too-large", "bad-request"}
    assert outcome.ends.total() == 100
    assert answered == 5
    growth_mib = peak_mib(server) - before
    print(f"the worker grew by {growth_mib:.1f} MiB: {outcome.ends}")
    assert growth_mib < 64


def test_silent_connections_are_cut_for_newer_ones_and_after_their_time(server):
    async def attack(target: AttackTarget) -> Outcome:
        return await attacks.silent_connects(target, 100)

    outcome, answered = attacked(server, attack)

    assert outcome.refused == 100
    assert answered == 5
    assert counted(server, "closed", "unauthenticated", 80)


def test_slow_request_heads_are_cut_after_the_handshake_timeout(server):
    async def attack(target: AttackTarget) -> Outcome:
        return await attacks.slow_headers(target, 20, pause_s=0.2)

    outcome, answered = attacked(server, attack)

    assert outcome.refused == 20
    assert outcome.slowest_s < 10 * ONE_S
    assert answered == 5


def _raw(first: int, *, masked: bool = True, length: bytes = b"\x00", payload: bytes = b"") -> bytes:
    """Return a frame with any first byte and any length; the mask is zero."""
    second = bytes([length[0] | (0x80 if masked else 0)]) + length[1:]
    return bytes([first]) + second + (bytes(4) if masked else b"") + payload


BROKEN_FRAMES = {
    "unmasked text": _raw(0x81, masked=False, length=b"\x02", payload=b"{}"),
    "unmasked ping": _raw(0x89, masked=False),
    "unmasked close": _raw(0x88, masked=False),
    **{f"reserved bits {bits}": _raw(0x82 | bits << 4) for bits in range(1, 8)},
    **{f"opcode {number}": _raw(0x80 | number) for number in (3, 4, 5, 6, 7, 11, 12, 13, 14, 15)},
    "length 2^63": _raw(0x82, length=b"\x7f" + (1 << 63).to_bytes(8, "big")),
    "length 2^64 - 1": _raw(0x82, length=b"\x7f" + b"\xff" * 8),
    "length 2^40": _raw(0x82, length=b"\x7f" + (1 << 40).to_bytes(8, "big")),
    "a short length in 16 bits": _raw(0x82, length=b"\x7e\x00\x01", payload=b"x"),
    "a short length in 64 bits": _raw(0x82, length=b"\x7f" + bytes(7) + b"\x01", payload=b"x"),
    "fragmented ping": _raw(0x09),
    "long ping": _raw(0x89, length=b"\x7e\x00\x7e", payload=bytes(126)),
    "close of one byte": _raw(0x88, length=b"\x01", payload=b"\x03"),
    "close with 1005": _raw(0x88, length=b"\x02", payload=b"\x03\xed"),
    "nothing to continue": _raw(0x80),
    "text in text": _raw(0x01) + _raw(0x81),
    "text that is not UTF-8": _raw(0x81, length=b"\x01", payload=b"\xff"),
    "another request": b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
    "zeros": bytes(1000),
}
"""What RFC 6455 forbids; each ends the connection with one of the codes that it names."""


def test_frames_that_the_protocol_forbids_end_their_own_connection_only(server):
    async def attack(target: AttackTarget) -> Outcome:
        outcome = Outcome()
        for data in BROKEN_FRAMES.values():
            robot = await target.enter(server.token(f"hostile-{next(_NUMBERS)}"), "bin")
            robot.send(data)
            assert await asyncio.wait_for(robot.hear(), SOON_S) is None
            outcome.ends[str(robot.closed)] += 1
            robot.writer.transport.abort()
        return outcome

    outcome, answered = attacked(server, attack)

    assert sum(outcome.ends.values()) == len(BROKEN_FRAMES)
    assert set(outcome.ends) <= {"1002", "1007", "1009"}
    assert answered == 5
    assert "defect" not in server.log


async def test_equal_ids_and_streams_of_several_robots_are_kept_apart(server):
    target = AttackTarget(server.url)
    robots = [await target.enter(server.token(f"twin-{n}"), "bin") for n in range(20)]
    heard: list[tuple[int, object]] = []
    for number, robot in enumerate(robots):
        for identity in (1, 2):
            command = Command(id=identity, service="echo", payload={"value": number}, stream="s", keep=True)
            robot.say(command)
    for number, robot in enumerate(robots):
        for _ in (1, 2):
            answer = await asyncio.wait_for(robot.hear(), SOON_S)
            assert isinstance(answer, Result), answer
            heard.append((number, answer.reply["value"]))
        robot.end()

    assert len(heard) == 40
    assert all(number == value for number, value in heard)
