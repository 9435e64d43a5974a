"""The actions status and unblock, against control ports that answer what the test says."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from rse_pf.cli.main import main
from rse_pf.local.processes import ProcessMark
from rse_pf.local.state import PlatformState, ServerState, state_folder

TOKEN = "ab" * 32
ROBOT = {
    "service": "icp",
    "reason": "overruns",
    "tenant": "acme",
    "robot": "robot-1",
    "requests": 0,
    "left_s": 41.7,
}
TENANT = {
    "service": "icp",
    "reason": "poison",
    "tenant": "acme",
    "robot": None,
    "requests": 3,
    "left_s": 500.0,
}
ALL = {"service": "pose", "reason": "crashes", "tenant": None, "robot": None, "requests": 0, "left_s": 9.2}


class ControlPort:
    """A control port whose answer is set by the test."""

    def __init__(self, name: str = "server-1") -> None:
        self.status, self.asked = 200, list[str]()
        self.answer: Any = {"server": name, "blocks": [], "count": 0, "silent_workers": 0}
        port = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                port.asked.append(
                    f"{self.command} {self.path} {self.headers.get('Authorization', '')}".strip()
                )
                body = json.dumps(port.answer).encode()
                self.send_response(port.status)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            do_POST = do_GET

            def log_message(self, *_: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = self._server.server_port
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,))
        self._thread.start()

    def refuses(self, *blocks: dict[str, Any]) -> None:
        self.answer |= {"blocks": list(blocks), "count": len(blocks)}

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


@pytest.fixture
def ports() -> Iterator[list[ControlPort]]:
    ports = [ControlPort("server-1"), ControlPort("server-2")]
    yield ports
    for port in ports:
        port.close()


@pytest.fixture
def platform(ports: list[ControlPort], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> PlatformState:
    """The state of a platform with both servers, in the folder where the verb looks for it."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    folder = state_folder("default", {"XDG_STATE_HOME": str(tmp_path)})
    folder.mkdir(parents=True)
    token_file = folder / "control.token"
    token_file.write_text(TOKEN)
    token_file.chmod(0o600)
    mark = ProcessMark(pid=1, began="")
    servers = [
        ServerState(name=f"server-{i}", process=mark, control_port=port.port)
        for i, port in enumerate(ports, 1)
    ]
    state = PlatformState(
        name="default", control_plane=mark, url="ws://127.0.0.1:1/ws", settings_digest="", settings_file="",
        key_file="", control_token_file=str(token_file), servers=tuple(servers),
    )  # fmt: skip
    state.write(folder)
    return state


def told(capsys: pytest.CaptureFixture[str], *words: str, code: int = 0) -> str:
    """Return what the verb writes to standard output and error."""
    assert main(["service", *words]) == code
    written = capsys.readouterr()
    assert "Traceback" not in written.err
    return written.out + written.err


def test_status_shows_what_is_refused_to_whom_why_and_for_how_long(capsys, ports, platform):
    ports[0].refuses(ALL, TENANT)
    ports[1].refuses(ROBOT)

    lines = told(capsys, "status").splitlines()

    assert [line.split() for line in lines[1:]] == [
        ["server-1", "pose", "all", "robots", "crashes", "9", "s"],
        ["server-1", "icp", "tenant", "acme", "3", "poison", "requests", "500", "s"],
        ["server-2", "icp", "robot", "acme/robot-1", "overrun", "deadlines", "42", "s"],
    ]
    assert [port.asked for port in ports] == [[f"GET /blocks Bearer {TOKEN}"]] * 2


def test_names_that_robots_chose_cannot_control_the_terminal(capsys, ports, platform):
    ports[0].refuses({**ROBOT, "tenant": "a\x1b[2J", "robot": "r\nserver-9 all is well\u202e"})

    written = told(capsys, "status")

    assert "\x1b" not in written
    assert "\u202e" not in written
    assert len(written.splitlines()) == 2


@pytest.mark.parametrize(
    ("words", "target"),
    [
        ((), "/unblock"),
        (("icp",), "/unblock?service=icp"),
        (("icp", "--robot", "robot-1"), "/unblock?service=icp&tenant=default&robot=robot-1"),
        (("--robot", "a&b c", "--tenant", "acme"), "/unblock?tenant=acme&robot=a%26b+c"),
        (("--tenant", "acme"), "/unblock?tenant=acme"),
    ],
)
def test_unblock_asks_every_server_for_what_is_named(capsys, ports, platform, words, target):
    told(capsys, "unblock", *words)

    assert [[line.split()[:2] for line in port.asked] for port in ports] == [[["POST", target]]] * 2


def test_unblock_says_what_was_lifted_where(capsys, ports, platform):
    ports[1].refuses(ROBOT)
    ports[1].answer["count"] = 8

    assert told(capsys, "unblock") == (
        "server-2: icp is no longer refused to robot acme/robot-1 (overrun deadlines)\nserver-2: and 7 more\n"
    )


def test_a_server_that_does_not_answer_is_named_and_the_others_are_shown(capsys, ports, platform):
    ports[0].refuses(ALL)
    ports[0].answer["silent_workers"] = 1
    ports[1].answer = ["no", "answer"]

    written = told(capsys, "status", code=1)

    assert "pose" in written
    assert "no answer from server-2" in written
    assert "no answer from 1 workers of server-1" in written


@pytest.mark.parametrize(
    ("status", "code", "word"),
    [(401, 2, "--control-token"), (404, 1, "earlier version"), (403, 1, "own machine"), (500, 1, "500")],
)
def test_a_server_that_refuses_says_why(capsys, ports, status, code, word):
    ports[0].status, ports[0].answer = status, {"hint": "unblock from the server's own machine"}

    assert word in told(capsys, "unblock", "--control-port", str(ports[0].port), code=code)


def test_a_server_without_a_platform_is_asked_at_its_port_with_its_token(capsys, ports, tmp_path):
    token = tmp_path / "token"
    token.write_text(TOKEN)
    token.chmod(0o600)
    port = str(ports[0].port)

    told(capsys, "status", "--control-port", port, "--control-token", str(token))

    assert ports[0].asked == [f"GET /blocks Bearer {TOKEN}"]
    assert "is not a port" in told(capsys, "status", "--control-port", "0", code=2)
