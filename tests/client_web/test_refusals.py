"""The web client distinguishes the refusal of a server from that of a firewall or proxy."""

from __future__ import annotations

import json
import subprocess
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from rse_pf.wire.refusal import refusal_body
from tests.client_web.test_failures import node

MODULE = Path(__file__).resolve().parents[2] / "client_web" / "rse-pf.js"
PROGRAM = """
const { connect } = await import(process.argv[1]);
try {
  const token = process.argv[3] === "function" ? () => "a.b.c" : "a.b.c";
  await connect(process.argv[2], { token, connectTimeoutMs: 1000 });
} catch (error) {
  console.log(JSON.stringify({ code: error.code }));
}
process.exit(0);
"""


def refused_with(status: int, body: bytes, token: str = "string") -> tuple[str, int]:
    """Return the code of the error of `connect`, and how often it asked why a handshake failed."""
    asked: list[str] = []

    class Refuses(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if "websocket" not in self.headers.get("Upgrade", ""):
                asked.append(self.path)
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            return

    with ThreadingHTTPServer(("127.0.0.1", 0), Refuses) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        url = f"ws://127.0.0.1:{server.server_address[1]}/ws"
        done = subprocess.run(
            [node(), "--input-type=module", "-e", PROGRAM, str(MODULE), url, token],
            capture_output=True, text=True, timeout=60, check=True,
        )  # fmt: skip
        server.shutdown()
    return json.loads(done.stdout)["code"], len(asked)


def test_a_token_that_a_server_refuses_ends_connect_at_once() -> None:
    assert refused_with(401, refusal_body("unauthorized", "no", "")) == ("unauthorized", 1)


@pytest.mark.parametrize(("token", "since_s"), [("string", 60.0), ("string", 0.0), ("function", 60.0)])
def test_a_cut_off_that_another_attempt_would_not_pass_ends_connect_at_once(
    token: str, since_s: float
) -> None:
    told = {"cause": "cut-off", "valid_from_s": time.time() - since_s}
    body = refusal_body("unauthorized", "tokens are revoked", "sign another one", **told)

    assert refused_with(401, body, token) == ("unauthorized", 1)


@pytest.mark.parametrize("status", [401, 403, 429])
def test_a_refusal_of_a_firewall_is_temporary_and_is_not_asked_about_each_time(status: int) -> None:
    code, questions = refused_with(status, b"<html>Forbidden</html>")

    assert (code, questions) == ("connect", 1)
