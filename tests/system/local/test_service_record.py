"""A service of a live platform: its requests are recorded for the operator alone, and its output is kept."""

from __future__ import annotations

import asyncio
import json
import time
from pathlib import Path

import pytest

from client_sdk import connect
from rse_pf.auth.tokens import SigningKey
from rse_pf.cli.main import main
from rse_pf.config import PlatformSettings
from rse_pf.errors import UnknownService
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.local.servers.control_client import ControlPort
from rse_pf.services.custom.installed import install
from rse_pf.services.custom.request_files import read_requests

pytestmark = [pytest.mark.system, pytest.mark.slow]

SOURCE = """
import msgspec

class Request(msgspec.Struct):
    text: str
class Reply(msgspec.Struct):
    letters: int

def serve(request: Request) -> Reply:
    print("counting", len(request.text), end="")
    return Reply(letters=len(request.text))
"""
DEADLINE_S = 30.0
SECRET = SigningKey.from_seed(b"s" * 32, "k1").issue(
    "other", now=1e9, token_id="t", settings=PlatformSettings().auth
)


@pytest.fixture
def services(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    folder = tmp_path / "letters"
    (folder / "requests").mkdir(parents=True)
    (folder / "service.json").write_text('{"name": "letters", "language": "python", "entry": "service.py"}')
    (folder / "service.py").write_text(SOURCE)
    (folder / "requests" / "one.json").write_text('{"request": {"text": "abc"}, "reply": {"letters": 3}}')
    install(folder, tmp_path / "services")
    return tmp_path / "services"


async def test_requests_of_robots_are_recorded_without_tokens_and_replayed(
    services: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = PlatformSettings().replace(services={"folder": str(services), "accept_weak_isolation": True})
    state = tmp_path / "state" / "rse-pf" / "default"
    async with LocalPlatform(settings, state=state, servers=1, port=0, adoptable=True) as platform:
        server = json.loads((state / "platform.json").read_text())["servers"][0]
        port = ControlPort(server["control_port"])
        denied = await port.ask("/record?service=letters&count=5", timeout_s=5, method="POST")
        port.close()
        words = ["service", "record", "letters", "--out", "live.jsonl", "--count", "3", "--seconds", "25"]
        recording = asyncio.create_task(asyncio.to_thread(main, words))
        robots = [connect(platform.url, token=platform.issue_token(f"robot-{n}")) for n in range(2)]
        async with robots[0] as one, robots[1] as two:
            end = time.monotonic() + DEADLINE_S
            while not recording.done() and time.monotonic() < end:
                await one.call("letters", {"text": f"my token is {SECRET}"})
                await two.call("letters", {"text": "plain"})
            unknown = ""
            try:
                await one.call("leters", {})
            except UnknownService as error:
                unknown = error.message
        code, denied = await recording, denied.status

    assert (code, denied) == (0, 401)
    assert "letters" in unknown
    text = Path("live.jsonl").read_text()
    assert len(read_requests(Path("live.jsonl")).calls) == 3
    assert "my token is [left out" in text
    for secret in (SECRET, "robot-0", "robot-1", "eyJ"):
        assert secret not in text
    logs = "".join(file.read_text() for file in (tmp_path / "state" / "rse-pf" / "default").glob("*.log"))
    assert SECRET not in logs
    assert "counting 5" in logs, "what the service printed without a newline, when its sandbox ended"
    capsys.readouterr()
    repeat = ["service", "test", "letters", "--requests", "live.jsonl"]
    assert await asyncio.to_thread(main, repeat) == 0
    assert "3 of 3 recorded requests as expected" in capsys.readouterr().out


def test_run_shows_what_a_service_prints_with_its_robot(
    services: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["service", "run", "letters", "--once"]) == 0

    shown = capsys.readouterr().out
    assert "robot-1  | counting 3" in shown
