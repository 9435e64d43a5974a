"""The page refuses what has no key, other origins and other names; its files are a fixed table."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
from collections.abc import Mapping
from typing import Any

import pytest

from rse_pf.errors import UsageError
from rse_pf.extensions.fleet_page.app import CONTENT_SECURITY_POLICY, FleetApp, PageAccess, PageActions
from rse_pf.extensions.fleet_page.hub import MAX_PAGES, Hub
from rse_pf.extensions.fleet_page.page_sessions import MAX_SESSIONS, PageSessions
from rse_pf.extensions.fleet_page.static_files import page_files

HOST = "127.0.0.1:8701"
ADMIN = "ab" * 32
FILES = page_files()


class Page:
    """The application, asked without a socket."""

    def __init__(self) -> None:
        numbers = itertools.count()
        self.hub = Hub()
        self.sessions = PageSessions(secret=lambda: f"secret-{next(numbers)}")
        self.done: list[tuple[str, dict[str, str]]] = []
        access = PageAccess(sessions=self.sessions, admin_token=lambda: ADMIN)
        actions = PageActions(operate=self._operate, page=self._page)
        self.app = FleetApp(self.hub, access, FILES, actions, clock=lambda: 0.0)

    async def _operate(self, action: str, parameters: Mapping[str, str]) -> Mapping[str, Any]:
        if action == "drain":
            raise UsageError("\x1b it is the last", hint="no")
        self.done.append((action, dict(parameters)))
        return {"event": "operation-over"}

    async def _page(self, name: str, query: Mapping[str, str]) -> tuple[str, bytes]:
        return "application/json", json.dumps([name, query]).encode()

    def session(self, role: Any = "view") -> dict[str, str]:
        token, _ = self.sessions.open(self.sessions.new_key(role, now_s=0.0), now_s=0.0)
        return {"authorization": f"Bearer {token}"}

    def ask(
        self, method: str, target: str, body: Any = None, headers: Mapping[str, str] | None = None
    ) -> tuple[int, dict[str, str], bytes]:
        sent, data = asyncio.run(self.sent(method, target, body, headers))
        start = sent[0]
        reported = {name.decode(): value.decode() for name, value in start["headers"]}
        return start["status"], reported, data

    async def sent(
        self, method: str, target: str, body: Any, headers: Mapping[str, str] | None
    ) -> tuple[list[Any], bytes]:
        path, _, query = target.partition("?")
        raw = body if isinstance(body, bytes) else json.dumps(body).encode()
        given = {"host": HOST, **(headers or {})}
        scope = {
            "type": "http", "method": method, "path": path, "query_string": query.encode(),
            "headers": [(name.encode(), value.encode("latin-1")) for name, value in given.items()],
        }  # fmt: skip
        sent: list[Any] = []

        bodies = [raw]

        async def receive() -> Any:
            if not bodies:
                await asyncio.Event().wait()  # the browser stays
            return {"type": "http.request", "body": bodies.pop(), "more_body": False}

        async def send(message: Any) -> None:
            sent.append(message)
            if message.get("more_body") and len(sent) > 2:
                raise OSError("the browser left")

        with contextlib.suppress(OSError):
            await self.app(scope, receive, send)
        return sent, b"".join(each.get("body", b"") for each in sent)


@pytest.mark.parametrize(
    ("method", "target"),
    [
        ("GET", "/stream?topics=fleet"),
        ("GET", "/page/maps"),
        ("GET", "/page/replay?id=1"),
        ("POST", "/act"),
        ("POST", "/operator"),
        ("POST", "/keys"),
    ],
)
@pytest.mark.parametrize("headers", [{}, {"authorization": "Bearer guessed"}, {"cookie": "session=secret-1"}])
def test_without_a_session_nothing_is_shown_or_done(
    method: str, target: str, headers: dict[str, str]
) -> None:
    page = Page()
    page.session()

    status, _, body = page.ask(method, target, {"action": "kill", "server": "server-1", "key": "x"}, headers)

    assert status == 401
    assert json.loads(body)["code"] == "unauthorized"
    assert page.done == []


@pytest.mark.parametrize(
    "headers",
    [
        {"origin": "http://evil.example"},
        {"origin": "null"},
        {"origin": "http://127.0.0.1:9999"},
        {"sec-fetch-site": "cross-site"},
        {"sec-fetch-site": "same-site"},
        {"host": "rebound.example:8701"},
        {"host": "127.0.0.1.rebound.example:8701"},
        {"host": "localhost:8701@rebound.example"},
        {"host": "127.0.0.2:8701"},
    ],
)
def test_other_origins_and_names_are_refused_even_with_a_session(headers: dict[str, str]) -> None:
    page = Page()
    session = page.session("operate")

    for method, target in (("POST", "/act"), ("GET", "/stream?topics=fleet"), ("GET", "/main.js")):
        status, _, _ = page.ask(method, target, {"action": "kill", "server": "s"}, {**session, **headers})
        assert status == 403, (method, target)
    assert page.done == []


@pytest.mark.parametrize("host", ["127.0.0.1:9999", "localhost:9999", "[::1]:9999", "localhost"])
def test_a_page_behind_a_forwarded_port_is_served_to_itself_only(host: str) -> None:
    page = Page()
    session = page.session("operate")
    order = {"action": "kill", "server": "server-1"}

    assert page.ask("POST", "/act", order, {**session, "host": host, "origin": f"http://{host}"})[0] == 200
    assert page.ask("POST", "/act", order, {**session, "host": host, "origin": f"http://{HOST}"})[0] == 403


def test_only_an_operator_operates() -> None:
    page = Page()
    viewer, operator = page.session(), page.session("operate")
    order = {"action": "kill", "server": "server-1"}

    assert page.ask("POST", "/act", order, viewer)[0] == 403
    assert page.done == []
    assert page.ask("POST", "/act", order, operator)[0] == 200
    assert page.done == [("kill", {"server": "server-1"})]
    status, _, body = page.ask("POST", "/act", {"action": "drain"}, operator)
    assert (status, json.loads(body)["message"]) == (400, r"\x1b it is the last")


@pytest.mark.parametrize(
    "path",
    ["/../app.py", "/vendor/vendored.json", "/static/main.js", "/%2e%2e/server.py", "//main.js", "/vendor"],
)
def test_only_the_files_of_the_table_are_served(path: str) -> None:
    assert Page().ask("GET", path)[0] == 404


def test_every_answer_has_the_policy_that_forbids_scripts_of_others() -> None:
    page = Page()
    for method, target in (
        ("GET", "/"),
        ("GET", "/style.css"),
        ("GET", "/nowhere"),
        ("POST", "/act"),
    ):
        _, headers, _ = page.ask(method, target, {})
        assert headers["content-security-policy"] == CONTENT_SECURITY_POLICY
        assert headers["x-content-type-options"] == "nosniff"
    assert "default-src 'none'" in CONTENT_SECURITY_POLICY
    assert "unsafe" not in CONTENT_SECURITY_POLICY


def test_a_session_reads_the_stream_and_too_many_pages_are_refused() -> None:
    page = Page()
    session = page.session()
    page.hub.append("event", {"text": "happened"})

    sent, data = asyncio.run(page.sent("GET", "/stream?topics=event", None, session))
    assert sent[0]["status"] == 200
    assert b"happened" in data
    assert page.ask("GET", "/stream?topics=nothing", None, session)[0] == 400

    async def many() -> list[int]:
        held = [page.hub.messages(frozenset(("event",))) for _ in range(MAX_PAGES)]
        for each in held:
            await each.__anext__()
        answers = [(await page.sent("GET", "/stream?topics=event", None, session))[0] for _ in range(168)]
        for each in held:
            await each.aclose()
        return [each[0]["status"] for each in answers]

    assert set(asyncio.run(many())) == {503}


def test_a_stream_ends_with_its_session() -> None:
    page = Page()
    session = page.session()
    for number in range(3):
        page.hub.append("event", {"text": f"event-{number}"})
    seen: list[bytes] = []

    async def send(message: Any) -> None:
        seen.append(message.get("body", b""))
        if b"event-0" in seen[-1]:  # other pages take the place of the session that was used longest ago
            for _ in range(MAX_SESSIONS):
                page.sessions.open(page.sessions.new_key("view", now_s=1.0), now_s=1.0)
        if b"event-2" in seen[-1]:
            raise OSError("the browser left")

    async def receive() -> Any:
        await asyncio.Event().wait()  # the browser stays

    scope = {
        "type": "http", "method": "GET", "path": "/stream", "query_string": b"topics=event",
        "headers": [(b"host", HOST.encode()), (b"authorization", session["authorization"].encode())],
    }  # fmt: skip
    with contextlib.suppress(OSError):
        asyncio.run(page.app(scope, receive, send))

    assert any(b"event-0" in each for each in seen)
    assert not any(b"event-1" in each or b"event-2" in each for each in seen)


def test_a_browser_that_leaves_gives_its_place_up_before_the_next_message() -> None:
    page = Page()
    session = page.session()
    begun, left = asyncio.Event(), asyncio.Event()

    async def send(message: Any) -> None:
        if message.get("more_body"):
            begun.set()

    async def receive() -> Any:
        await left.wait()
        return {"type": "http.disconnect"}

    scope = {
        "type": "http", "method": "GET", "path": "/stream", "query_string": b"topics=event",
        "headers": [(b"host", HOST.encode()), (b"authorization", session["authorization"].encode())],
    }  # fmt: skip

    async def come_and_go() -> tuple[int, int]:
        stream = asyncio.ensure_future(page.app(scope, receive, send))
        await asyncio.wait_for(begun.wait(), 5)
        open_pages = page.hub.pages
        left.set()
        await asyncio.wait_for(stream, 5)
        return open_pages, page.hub.pages

    assert asyncio.run(come_and_go()) == (1, 0)
