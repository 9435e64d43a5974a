"""A service of a live platform: what it prints is kept, and shown to its author."""

from __future__ import annotations

from pathlib import Path

import pytest

from client_sdk import connect
from rse_pf.auth.tokens import SigningKey
from rse_pf.cli.main import main
from rse_pf.config import PlatformSettings
from rse_pf.errors import UnknownService
from rse_pf.local.control.platform import LocalPlatform
from rse_pf.services.custom.installed import install

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


async def test_the_log_keeps_what_a_service_prints_and_no_token_of_a_request(
    services: Path, tmp_path: Path
) -> None:
    settings = PlatformSettings().replace(services={"folder": str(services), "accept_weak_isolation": True})
    state = tmp_path / "state" / "rse-pf" / "default"
    async with (
        LocalPlatform(settings, state=state, servers=1, port=0, adoptable=True) as platform,
        connect(platform.url, token=platform.issue_token("robot-1")) as robot,
    ):
        await robot.call("letters", {"text": "plain"})
        await robot.call("letters", {"text": f"my token is {SECRET}"})
        with pytest.raises(UnknownService, match="letters"):
            await robot.call("leters", {})

    logs = "".join(file.read_text() for file in state.glob("*.log"))
    assert SECRET not in logs
    assert "counting 5" in logs, "what the service printed without a newline, when its sandbox ended"


def test_run_shows_what_a_service_prints_with_its_robot(
    services: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["service", "run", "letters", "--once"]) == 0

    shown = capsys.readouterr().out
    assert "robot-1  | counting 3" in shown
