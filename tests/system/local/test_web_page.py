"""A web page as a robot, through the load balancer: no log holds its token, and its origin is judged."""

from __future__ import annotations

import asyncio
import json
import urllib.error
import urllib.request
from pathlib import Path

import pytest
import websockets
from websockets.asyncio.client import connect

from rse_pf.config import PlatformSettings
from rse_pf.local.control.platform import LocalPlatform

pytestmark = [pytest.mark.system, pytest.mark.slow]

PAGE = "https://robots.example.org"
LOUD = {"serving": {"allowed_origins": PAGE, "log_level": "debug"}}
BROWSER = "Mozilla/5.0"


async def answer(url: str, token: str, origin: str) -> tuple[int, str]:
    """Return the status of a handshake, and the sub-protocol or the code of the refusal."""
    offered = [websockets.Subprotocol(each) for each in ("rse-pf.v1.json", f"rse-pf.token.{token}")]
    try:
        async with connect(
            url, subprotocols=offered, origin=websockets.Origin(origin), user_agent_header=BROWSER, proxy=None
        ) as socket:
            await socket.send(json.dumps({"type": "hello"}))
            assert json.loads(await socket.recv())["type"] == "welcome"
            return 101, str(socket.subprotocol)
    except websockets.InvalidStatus as error:
        return error.response.status_code, json.loads(error.response.body or b"{}")["code"]


def preflight(url: str, origin: str) -> tuple[int, str | None]:
    headers = {"Origin": origin, "Access-Control-Request-Method": "PUT"}
    request = urllib.request.Request(url, method="OPTIONS", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=10) as reply:
            return reply.status, reply.headers["Access-Control-Allow-Origin"]
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.headers["Access-Control-Allow-Origin"]


def files_with(folder: Path, secrets: list[str]) -> dict[str, list[str]]:
    """Return in which files a part of a token stands; an access log that somebody adds would be one."""
    wanted = [part.encode() for each in secrets for part in each.split(".")[1:]]
    files = [each for each in folder.rglob("*") if each.is_file()]
    held = {each.name: [part.decode() for part in wanted if part in each.read_bytes()] for each in files}
    return {name: found for name, found in held.items() if found}


async def test_a_page_connects_by_its_token_which_no_log_holds(tmp_path: Path, capfd) -> None:
    folder = tmp_path / "p"

    settings = PlatformSettings.from_dict(LOUD)
    async with LocalPlatform(settings, state=folder, port=0, servers=1, data=True) as cloud:
        tokens = [cloud.issue_token(name) for name in ("page-1", "page-2", "page-3", "page-4")]
        tokens[3] = tokens[3][:-4] + "AAAA"
        own = f"http://127.0.0.1:{cloud.port}"
        origins = (PAGE, own, "https://evil.example", PAGE)
        told = [await answer(cloud.url, *each) for each in zip(tokens, origins, strict=True)]
        data = f"{own}/data/v1/objects/{'0' * 64}"
        asked = [await asyncio.to_thread(preflight, data, each) for each in (PAGE, "https://evil.example")]
        config = json.loads(next(folder.rglob("envoy*.json")).read_text())

    assert told == [
        (101, "rse-pf.v1.json"),
        (101, "rse-pf.v1.json"),
        (403, "forbidden"),
        (401, "unauthorized"),
    ]
    assert asked == [(204, PAGE), (403, None)]
    assert "access_log" not in json.dumps(config)
    assert {"server-1.log", "data-1.log", "load-balancer.log"} <= {
        each.name for each in folder.rglob("*.log")
    }
    assert files_with(folder, tokens) == {}
    written = "".join(capfd.readouterr())
    assert not [part for each in tokens for part in each.split(".")[1:] if part in written]
    (tmp_path / "planted").write_text(f"GET /ws {tokens[0]}")
    assert list(files_with(tmp_path, tokens)) == ["planted"], "the search finds what it looks for"
