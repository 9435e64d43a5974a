"""The action record, and test --requests: against control ports that record, and with wrong files."""

from __future__ import annotations

import base64
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import pytest

from rse_pf.cli.main import main
from rse_pf.services.custom.recording import Recording

TOKEN = "ab" * 32
PIECE = 64


class RecordingServer:
    """A control port whose two workers have recorded *calls* requests each when they are asked first."""

    def __init__(self, calls: int = 3, status: int = 200, offers: bool = True) -> None:
        self.asked: list[tuple[str, dict[str, str]]] = []
        self.authorizations: set[str] = set()
        workers = [Recording("icp", max_calls=100, max_bytes=1 << 20, until_s=1.0) for _ in range(2)]
        for number, worker in enumerate(workers):
            for call in range(calls):
                worker.add({"worker": number, "call": call}, {"sum": call}, None, 1.0, 0.0)
        port = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_POST(self) -> None:
                url = urlsplit(self.path)
                query = dict(parse_qsl(url.query))
                port.asked.append((url.path, query))
                port.authorizations.add(self.headers.get("Authorization", ""))
                if url.path == "/record/take":
                    rows = [port.row(n, worker) for n, worker in enumerate(workers)]
                else:
                    rows = [{"worker": n, "offers": offers} for n in range(2)]
                body = json.dumps({"server": "s", "workers": rows, "recording": 7, "hint": "a hint"}).encode()
                self.send_response(status)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: Any) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.port = str(self._server.server_port)
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,))
        self._thread.start()

    def row(self, number: int, worker: Recording) -> dict[str, Any]:
        data = base64.b64encode(worker.take(PIECE)).decode()
        return {"worker": number, "data": data, "waiting": worker.waiting_bytes, "is_over": True}

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


@pytest.fixture
def started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A function that starts a server; its token file is there, and no platform runs."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    Path("token").write_text(TOKEN)
    Path("token").chmod(0o600)
    servers: list[RecordingServer] = []

    def start(**how: Any) -> RecordingServer:
        servers.append(RecordingServer(**how))
        return servers[-1]

    yield start
    for server in servers:
        server.close()


def told(capsys: pytest.CaptureFixture[str], *words: str, code: int = 0) -> str:
    capsys.readouterr()
    assert main(["service", *words]) == code
    written = capsys.readouterr()
    assert "Traceback" not in written.err
    return written.out + written.err


def test_record_writes_what_all_workers_recorded_and_ends_the_recording(
    capsys: pytest.CaptureFixture[str], started: Any
) -> None:
    server = started()

    shown = told(
        capsys, "record", "icp", "--out", "live.jsonl", "--url", f"http://127.0.0.1:{server.port}",
        "--control-token", "token", "--count", "50", "--seconds", "20", "--max-mib", "2",
    )  # fmt: skip

    head, *lines = map(json.loads, Path("live.jsonl").read_text().splitlines())
    assert "6 requests to icp in live.jsonl" in shown
    assert (head["service"], head["requests"]) == ("icp", 6)
    assert {(line["request"]["worker"], line["request"]["call"]) for line in lines} == {
        (worker, call) for worker in range(2) for call in range(3)
    }
    assert server.authorizations == {f"Bearer {TOKEN}"}
    assert server.asked[0] == (
        "/record", {"service": "icp", "count": "50", "seconds": "20.0", "mib": "2"},
    )  # fmt: skip
    assert server.asked[-1] == ("/record", {"recording": "7", "count": "0"})


def test_a_recording_has_no_more_calls_than_were_asked_for(
    capsys: pytest.CaptureFixture[str], started: Any
) -> None:
    server = started()

    told(capsys, "record", "icp", "--out", "live.jsonl", "--control-port", server.port, "--count", "4")

    assert len(Path("live.jsonl").read_text().splitlines()) == 5


@pytest.mark.parametrize(
    ("how", "code", "says"),
    [
        ({"status": 401}, 2, "--control-token"),
        ({"status": 403}, 2, "a hint"),
        ({"status": 404}, 1, "earlier version"),
        ({"status": 500}, 1, "answers 500"),
        ({"offers": False}, 2, "no installed service named 'icp'"),
    ],
)
def test_a_server_that_does_not_record_says_why_and_no_file_is_written(
    capsys: pytest.CaptureFixture[str], started: Any, how: dict[str, Any], code: int, says: str
) -> None:
    server = started(**how)

    assert says in told(
        capsys, "record", "icp", "--out", "live.jsonl", "--control-port", server.port, code=code
    )
    assert not Path("live.jsonl").exists()


@pytest.mark.system
def test_a_recording_is_replayed_and_compared_if_that_is_wanted(
    capsys: pytest.CaptureFixture[str], started: Any
) -> None:
    main(["service", "new", "mine"])
    example = json.loads(Path("mine/requests/example.json").read_text())
    lines = [
        {"format": "rse-pf-requests", "version": 1, "service": "mine"},
        {"request": example["request"], "reply": {"centroid": [9, 9, 9], "radius": 1}},
        {"request": {"points": []}, "failure": "bad-request"},
    ]
    Path("live.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))

    compared = told(capsys, "test", "mine", "--requests", "live.jsonl", "--compare", code=1)

    assert "live.jsonl number 1" in compared  # as --number of debug counts
    assert "reply.centroid[0] is 1.0, expected 9" in compared
    assert "1 of 2 recorded requests as expected" in compared
