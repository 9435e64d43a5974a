"""Web pages of listed origins may use the data service; browsers keep others from its replies."""

from __future__ import annotations

import pytest

from rse_pf.storage.object_store import MemoryStore, digest_of
from tests.kit.fake_data_service import Service, small_settings

PAGE = "https://robots.example.org"
DATA = b"a keyframe"
OBJECT = f"/data/v1/objects/{digest_of(DATA)}"
ASKED = {"origin": PAGE, "access-control-request-method": "PUT"}


@pytest.fixture
def shared() -> Service:
    settings = small_settings().replace(serving={"allowed_origins": PAGE})
    return Service(settings, MemoryStore())


def test_a_listed_page_may_read_replies_and_errors(shared: Service) -> None:
    stored = shared.ask("PUT", OBJECT, DATA, headers={"origin": PAGE})
    part = shared.ask("GET", OBJECT, headers={"origin": PAGE, "range": "bytes=0-3"})
    refused = shared.ask("GET", OBJECT, token="x", headers={"origin": PAGE})

    assert (stored.status, part.status, refused.status) == (201, 206, 401)
    for reply in (stored, part, refused):
        assert reply.headers["access-control-allow-origin"] == PAGE
        assert reply.headers["vary"] == "Origin"
        assert "access-control-allow-credentials" not in reply.headers
        assert "content-range" in reply.headers["access-control-expose-headers"]


def test_a_browser_learns_what_a_listed_page_may_send(shared: Service) -> None:
    reply = shared.ask("OPTIONS", OBJECT, token="", headers=ASKED)

    assert reply.status == 204
    assert reply.headers["access-control-allow-methods"] == "GET, HEAD, PUT, DELETE"
    assert reply.headers["access-control-allow-origin"] == PAGE
    assert {"authorization", "content-type", "if-none-match"} <= set(
        reply.headers["access-control-allow-headers"].split(", ")
    )
    assert shared.ask("OPTIONS", "/data/v1/nothing", token="", headers=ASKED).status == 404


@pytest.mark.parametrize("origin", ["https://other.example", "null", f"{PAGE}:444"])
def test_other_pages_are_refused_before_anything_is_stored(shared: Service, origin: str) -> None:
    asked = shared.ask("OPTIONS", OBJECT, token="", headers={**ASKED, "origin": origin})
    sent = shared.ask("PUT", OBJECT, DATA, headers={"origin": origin})

    assert [asked.status, sent.status] == [403, 403]
    assert not [name for name in (*asked.headers, *sent.headers) if name.startswith("access-control")]
    assert list(shared.store.list()) == []


def test_robots_and_the_platforms_own_pages_need_no_entry(shared: Service) -> None:
    own = {"origin": "http://127.0.0.1:8700", "host": "127.0.0.1:8700"}

    assert shared.ask("PUT", OBJECT, DATA, headers=own).status == 201
    robot = shared.ask("GET", OBJECT)
    assert (robot.status, robot.body) == (200, DATA)
    assert "access-control-allow-origin" not in robot.headers
    assert shared.ask("OPTIONS", OBJECT).status == 405
