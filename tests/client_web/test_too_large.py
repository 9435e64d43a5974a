"""A body that is too large gets its 413 also in Chromium, which is sending it, through the balancer."""

from __future__ import annotations

import socket
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from tests.examples.conftest import ExamplePlatform
from tests.examples.conftest import platform as platform
from tests.kit.chromium import chromium

pytestmark = [pytest.mark.slow, pytest.mark.system, pytest.mark.timeout(300)]

HAS_DATA = True
TIMES = 5
MIB = 1 << 20
with socket.create_server(("127.0.0.1", 0)) as _free:
    PORT = _free.getsockname()[1]
ALLOWED_ORIGINS = f"http://127.0.0.1:{PORT}"
STORE = """
async ([url, token, size]) => {
  const response = await fetch(url, {
    method: "PUT", body: new Uint8Array(size), headers: { Authorization: "Bearer " + token },
  });
  return [response.status, (await response.json()).code];
}
"""


class Page(BaseHTTPRequestHandler):
    """An empty page."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_: object) -> None:
        """Write nothing."""


@pytest.mark.parametrize("size", [5 * MIB, 60 * MIB])
def test_the_answer_arrives_in_chromium_through_the_balancer(platform: ExamplePlatform, size: int) -> None:
    token = platform.cloud.issue_token("page", None)
    url = f"http://127.0.0.1:{platform.cloud.port}/data/v1/objects/{'a' * 64}"
    server = ThreadingHTTPServer(("127.0.0.1", PORT), Page)
    threading.Thread(target=server.serve_forever, daemon=True).start()

    with chromium() as browser:
        page = browser.new_page()
        page.goto(ALLOWED_ORIGINS)
        answers = [page.evaluate(STORE, [url, token, size]) for _ in range(TIMES)]
    server.shutdown()
    server.server_close()

    assert answers == [[413, "too-large"]] * TIMES
