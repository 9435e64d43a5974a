"""Logs hold what happened and nothing that a stranger may use: no token, no payload, no broken line (T15)."""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import websockets
import websockets.exceptions

from rse_pf.config import PlatformSettings
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.server.log import JsonLog
from rse_pf.wire import SUBPROTOCOLS, Command, Hello, make_codec

CODEC = make_codec("json")
HOSTILE = (
    "\r\n{\"event\":\"forged\"}", "\x1b[2J\x1b]0;owned\x07", "\u2028\u2029\u0085", "\0\0", "${jndi:ldap://x}",
    "%s%n", "\N{RIGHT-TO-LEFT OVERRIDE}", "'; drop table robots; --", '","level":"error","x":"', "\\",
    "\ud7ff\ue000", "x" * 64,
)  # fmt: skip
PAYLOAD = "payload-that-nobody-may-log"
NUMBER = 48151.62342
SOON_S = 20.0


def hostile_words(count: int, seed: int) -> list[str]:
    """Return *count* words of at most 64 characters that were written to break a line."""
    rng = random.Random(seed)
    letters = [chr(code) for code in range(0x20)] + list(
        '"\\{}[],:\x7f\x85\u2028\u2029\ufeff\uffff\U0001f916a'
    )
    pieces = [*HOSTILE, *letters, *letters]
    return ["".join(rng.choices(pieces, k=rng.randint(1, 9)))[:64] for _ in range(count)]


def test_ten_thousand_hostile_names_are_ten_thousand_lines(tmp_path: Path) -> None:
    words = hostile_words(10_000, seed=1)
    file = tmp_path / "log"
    with file.open("wb") as opened:
        log = JsonLog(level="debug", server="s-1", wall_clock=lambda: 5.0, fd=opened.fileno()).start()
        for word in words:
            log.info("command", robot=word, service=word, trace=word)
        log.close(SOON_S)

    lines = file.read_bytes().split(b"\n")[:-1]
    assert log.dropped == 0
    assert [json.loads(line)["trace"] for line in lines] == words
    assert all(json.loads(line)["event"] == "command" for line in lines)
    assert not any(byte < 32 for line in lines for byte in line)


async def refused(url: str, headers: dict[str, str]) -> None:
    """Knock with *headers*; whatever the listener says is written somewhere."""
    with contextlib.suppress(websockets.exceptions.WebSocketException, OSError, ValueError):
        async with websockets.connect(
            url, subprotocols=[SUBPROTOCOLS["json"]], additional_headers=headers, compression=None,
            open_timeout=SOON_S,
        ):  # fmt: skip
            pass


def ask_data(url: str, token: str) -> int:
    """Ask the data service for an object that is not there; return the status."""
    address = url.replace("ws://", "http://").rpartition("/")[0] + "/data/objects/" + "0" * 64
    request = urllib.request.Request(address, headers={"Authorization": f"Bearer {token}"})
    try:
        with urllib.request.urlopen(request, timeout=SOON_S) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        with error:
            return error.code


async def from_data(url: str, token: str) -> int:
    """Ask until the load balancer has found the data server."""
    status = 503
    while status == 503:
        status = await asyncio.to_thread(ask_data, url, token)
    return status


async def conversation(url: str, token: str, words: list[str]) -> int:
    """Send commands whose every word is hostile, bad ones among them; return how many were answered."""
    async with websockets.connect(
        url, subprotocols=[SUBPROTOCOLS["json"]], additional_headers={"Authorization": f"Bearer {token}"},
        compression=None, ping_interval=None, open_timeout=SOON_S,
    ) as socket:  # fmt: skip

        async def answer() -> Any:
            return CODEC.decode_from_server(await asyncio.wait_for(socket.recv(decode=False), SOON_S))

        await socket.send(CODEC.encode(Hello(sdk=words[0])).decode())
        await answer()
        answered = 0
        bad = [b"nonsense " + PAYLOAD.encode(), b"[" * 40]
        for number, word in enumerate(words):
            payload = (
                {"value": [PAYLOAD, NUMBER]}
                if number % 2
                else {"points_world": [NUMBER] * 3, "pixels": PAYLOAD}
            )
            service = ("echo", "pnp", word)[number % 3]
            command = Command(id=number, service=service, payload=payload, trace=word, stream=word, keep=True)
            await socket.send(CODEC.encode(command).decode())
            answered += (await answer()).id == number
        for data in bad:
            await socket.send(data.decode())
            answered += (await answer()).id is None
        return answered


@pytest.mark.system
async def test_no_token_and_no_payload_is_in_any_log_of_a_real_run(tmp_path: Path) -> None:
    loud = PlatformSettings().replace(serving={"log_level": "debug"}, session={"max_commands_per_s": 0.0})
    words = [*HOSTILE, *hostile_words(48, seed=2)]
    tokens: list[str] = []
    folder = tmp_path / "platform"

    async with LocalPlatform(loud, servers=1, port=0, state=folder, data=True) as cloud:
        tokens.extend(cloud.issue_token(f"robot-{number}") for number in range(3))
        good, other, _ = tokens
        damaged = other[:-6] + "AAAAAA"
        tokens.append(damaged)
        await refused(cloud.url, {"Authorization": f"Bearer {damaged}"})
        await refused(cloud.url, {"Authorization": f"Basic {other}"})
        await refused(cloud.url + f"?token={other}", {})
        await refused(cloud.url, {"Cookie": f"token={other}"})
        status = await asyncio.wait_for(from_data(cloud.url, other), SOON_S)
        await asyncio.to_thread(ask_data, cloud.url, damaged)
        answered, data_status = await conversation(cloud.url, good, words), status

    assert answered == len(words) + 2
    assert data_status == 404
    logs = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file() and file.suffix == ".log"}
    assert any(b'"command"' in text for text in logs.values()), "nothing was logged, so nothing was tested"
    parts = {part for token in tokens for part in token.split(".")[1:]} | {*tokens}
    for file, text in logs.items():
        for secret in (*parts, PAYLOAD, str(NUMBER)):
            assert secret.encode() not in text, f"{file.name} holds {secret[:20]}"
        if b'"event"' in text:
            for line in text.splitlines():
                assert isinstance(json.loads(line), dict), line
        assert b'"event":"forged"' not in text
