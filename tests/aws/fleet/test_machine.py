"""What the agent learns from its machine: Spot notices, CPU, and how many robots were asked to move."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import ClassVar

import pytest

from rse_pf.aws.fleet import instance
from rse_pf.aws.fleet.instance import Instance
from rse_pf.aws.fleet.metrics import read_cpu_times

STAT = "cpu  100 5 20 800 40 1 2 32 0 0\ncpu0 50 2 10 400 20 0 1 16 0 0\nintr 1\n"


class _Pages(BaseHTTPRequestHandler):
    """Instance metadata, and the control port of a server that has 5 robots that can move."""

    pages: ClassVar[dict[str, str]] = {}

    def do_GET(self) -> None:
        text = self.pages.get(self.path)
        self.send_response(404 if text is None else 200)
        self.end_headers()
        self.wfile.write((text or "").encode())

    def do_PUT(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b"session")

    do_POST = do_GET

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[Instance]:
    """An instance whose metadata and control port are `_Pages`."""
    _Pages.pages.clear()
    with HTTPServer(("127.0.0.1", 0), _Pages) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        monkeypatch.setattr(instance, "_IMDS", f"http://127.0.0.1:{server.server_port}/latest/")
        yield Instance(server.server_port)
        server.shutdown()
        thread.join()


@pytest.mark.system
def test_a_notice_is_found_in_the_metadata_and_its_absence_is_none(machine: Instance) -> None:
    assert machine.spot_notice() == ""
    _Pages.pages["/latest/meta-data/events/recommendations/rebalance"] = '{"noticeTime": "now"}'
    assert machine.spot_notice() == "rebalance"
    _Pages.pages["/latest/meta-data/spot/instance-action"] = '{"action": "terminate"}'
    assert machine.spot_notice() == "interruption"


def test_cpu_is_what_neither_idles_nor_waits_and_stolen_time_counts() -> None:
    assert read_cpu_times(STAT) == (160.0, 1000.0)
