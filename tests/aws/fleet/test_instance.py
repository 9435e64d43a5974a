"""The agent's requests to its own server: they carry the token; without a token no server runs."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import ClassVar

import pytest

from rse_pf.auth.control_token import bearer, ensure_control_token, read_control_token
from rse_pf.aws.fleet import agent
from rse_pf.aws.fleet.agent import main
from rse_pf.aws.fleet.instance import Instance
from rse_pf.errors import Disconnected, StoreError
from tests.kit.fake_store import FakeStore, do_nothing, fail_with


class _Port(BaseHTTPRequestHandler):
    heard: ClassVar[list[tuple[str, str, str | None]]] = []

    def do_GET(self) -> None:
        self.heard.append((self.command, self.path, self.headers["Authorization"]))
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b"numbers")

    do_POST = do_GET

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def port() -> Iterator[int]:
    """A control port that accepts every request and remembers it."""
    _Port.heard.clear()
    with HTTPServer(("127.0.0.1", 0), _Port) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield server.server_port
        server.shutdown()
        thread.join()


@pytest.mark.system
def test_metrics_and_drain_are_requested_with_the_current_token(port: int, tmp_path: Path) -> None:
    file = tmp_path / "control.token"
    control = Instance(port, file)
    first = ensure_control_token(file, seed=b"a" * 32)

    assert control.page() == "numbers"
    file.unlink()
    second = ensure_control_token(file, seed=b"b" * 32)
    control.drain(2.5)

    assert _Port.heard == [("GET", "/metrics", bearer(first)), ("POST", "/drain?wait=2.5", bearer(second))]


def test_the_unit_makes_the_token_before_any_request(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Nobody(Disconnected):
        pass

    def refuse(*_: object) -> None:
        raise Nobody("no network")

    monkeypatch.setattr("rse_pf.aws.fleet.agent.make_client", refuse)
    settings, token = tmp_path / "settings.json", tmp_path / "control.token"
    settings.write_text('{"context": {"rse-pf": {}}}')
    place = [
        "--bucket",
        "b",
        "--keys-name",
        "k",
        "--keys-file",
        "k",
        "--state",
        "s",
        "--group",
        "g",
        "--hook",
        "h",
    ]
    command = ["--settings", str(settings), *place, "--control-token", str(token)]

    assert main(command) == 2
    assert not token.exists()
    assert main([*command, "--once"]) == 2
    assert len(read_control_token(token)) == 64


def test_a_server_starts_again_without_the_bucket_but_only_with_what_this_boot_has_fetched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bucket = FakeStore()
    away = fail_with(StoreError("AWS does not answer"), "get")
    monkeypatch.setattr(agent, "make_client", lambda *_: None)
    monkeypatch.setattr(agent, "open_bucket", lambda *_: bucket)
    (tmp_path / "settings.json").write_text('{"context": {"rse-pf": {}}}')
    command = [
        "--settings", str(tmp_path / "settings.json"), "--bucket", "b", "--keys-name", "keys.json",
        "--group", "g", "--hook", "h", "--keys-file", str(tmp_path / "run" / "keys.json"), "--once",
        "--state", str(tmp_path),
    ]  # fmt: skip
    (tmp_path / "run").mkdir()
    bucket.before = away
    assert main(command) == 2, "a new machine has nothing"
    bucket.before = do_nothing
    assert main(command) == 0
    bucket.before = away

    assert main(command) == 0
    shutil.rmtree(tmp_path / "run")  # as a boot does
    (tmp_path / "run").mkdir()
    assert main(command) == 2, "what an earlier boot fetched may be weeks old"
