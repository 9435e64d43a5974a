"""The data service's replies: access, limits, ranges, and names that stay inside the store."""

from __future__ import annotations

import asyncio
import os
import tempfile
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from rse_pf.auth.tokens import SigningKey
from rse_pf.errors import Archived, StoreError
from rse_pf.storage.object_store import DirectoryStore, MemoryStore, ObjectInfo, digest_of
from tests.kit.fake_data_service import KEY, Service, small_settings
from tests.kit.fake_store import FakeStore, fail_with

DATA = bytes(range(256)) * 4
DIGEST = digest_of(DATA)
SMALL = small_settings()
OBJECT = f"/data/v1/objects/{DIGEST}"


def test_the_server_makes_the_name_of_an_object(service: Service) -> None:
    service.ask("PUT", OBJECT, DATA, robot="../../etc", tenant="a/b")

    (info,) = service.store.list("objects/")
    assert info.name.split("/")[0] == "objects"
    assert info.name.split("/")[3] == DIGEST
    assert ".." not in info.name


def test_bytes_with_another_digest_are_refused(service: Service) -> None:
    assert service.ask("PUT", OBJECT, DATA + b"x").status == 400
    assert list(service.store.list("objects/")) == []


def test_an_object_that_cannot_be_read_is_refused_as_a_whole(service: Service) -> None:
    service.store = FakeStore(fail_with(Archived("archived", hint="restore it"), "get_range"))
    service.restart()
    service.ask("PUT", OBJECT, DATA)

    answer = service.ask("GET", OBJECT)

    assert (answer.status, answer.json["code"]) == (409, "archived")
    assert service.ask("HEAD", OBJECT).status == 200


@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_an_object_of_another_robot_is_reported_as_missing(service: Service, method: str) -> None:
    service.ask("PUT", OBJECT, DATA)
    missing = service.ask(method, f"/data/v1/objects/{'0' * 64}", robot="robot-2")

    for stranger in ({"robot": "robot-2"}, {"tenant": "other"}):
        answer = service.ask(method, OBJECT, **stranger)
        assert answer.status == 404
        assert answer.body.replace(b"robot-2", b"") == missing.body
    assert service.ask("GET", "/data/v1/objects", robot="robot-2").json["objects"] == []


@pytest.mark.parametrize("token", ["", "x", "a.b.c", "forged", "expired"])
def test_the_reply_to_an_invalid_token_gives_no_reason(service: Service, token: str) -> None:
    if token == "forged":
        token = SigningKey.from_seed(b"z" * 32, KEY.key_id).issue(
            "robot-1", now=service.wall, token_id="t", settings=service.settings.auth
        )
    if token == "expired":
        token = service.token()
        service.wall += 2000

    answer = service.ask("GET", OBJECT, token=token)

    assert answer.status == 401
    assert answer.json["message"] == "the token is missing or not valid"
    assert answer.headers["www-authenticate"] == "Bearer"


def test_scopes_limit_a_token_and_a_token_without_scopes_is_unlimited(service: Service) -> None:
    reader, writer = service.token(scopes=("data:read",)), service.token(scopes=("data:write",))

    assert service.ask("PUT", OBJECT, DATA, token=reader).status == 403
    assert service.ask("PUT", OBJECT, DATA, token=writer).status == 201
    assert service.ask("GET", OBJECT, token=writer).status == 403
    assert service.ask("GET", OBJECT, token=reader).status == 200
    assert service.ask("GET", "/data/v1/maps", token=reader).status == 403


@pytest.mark.parametrize(
    ("asked", "status", "part", "told"),
    [
        ("bytes=0-9", 206, DATA[:10], "bytes 0-9/1024"),
        ("bytes=1000-", 206, DATA[1000:], "bytes 1000-1023/1024"),
        ("bytes=-24", 206, DATA[-24:], "bytes 1000-1023/1024"),
        ("bytes=1000-99999", 206, DATA[1000:], "bytes 1000-1023/1024"),
        ("bytes=0-0", 206, DATA[:1], "bytes 0-0/1024"),
        ("bytes=9-3", 200, DATA, None),
        ("bytes=0-1,5-6", 200, DATA, None),
        ("lines=1-2", 200, DATA, None),
    ],
)
def test_a_range_is_returned(
    service: Service, asked: str, status: int, part: bytes, told: str | None
) -> None:
    service.ask("PUT", OBJECT, DATA)

    answer = service.ask("GET", OBJECT, headers={"range": asked})

    assert (answer.status, answer.body) == (status, part)
    assert answer.headers.get("content-range") == told


TAG, OTHER_TAG = f'"{DIGEST}"', f'"{"0" * 64}"'


@pytest.mark.parametrize(
    ("method", "headers", "status"),
    [
        ("GET", {"if-none-match": TAG}, 304),
        ("HEAD", {"if-none-match": TAG}, 304),
        ("GET", {"if-none-match": f"{OTHER_TAG} , W/{TAG}"}, 304),
        ("GET", {"if-none-match": "*"}, 304),
        ("GET", {"if-none-match": OTHER_TAG}, 200),
        ("GET", {"if-none-match": DIGEST}, 200),
        ("GET", {"if-none-match": TAG, "range": "bytes=0-9"}, 304),
        ("GET", {"if-match": TAG}, 200),
        ("GET", {"if-match": "*", "range": "bytes=0-9"}, 206),
        ("GET", {"if-match": f"W/{TAG}"}, 412),
        ("GET", {"if-match": OTHER_TAG, "if-none-match": TAG}, 412),
        ("GET", {"if-match": OTHER_TAG, "range": "bytes=5000-"}, 412),
        ("HEAD", {"if-match": OTHER_TAG}, 412),
        ("GET", {"if-range": TAG, "range": "bytes=0-9"}, 206),
        ("GET", {"if-range": TAG, "range": "bytes=5000-"}, 416),
        ("GET", {"if-range": OTHER_TAG, "range": "bytes=0-9"}, 200),
        ("GET", {"if-range": OTHER_TAG, "range": "bytes=5000-"}, 200),
        ("GET", {"if-range": f"W/{TAG}", "range": "bytes=0-9"}, 200),
        ("GET", {"if-range": "Sun, 29 Nov 2026 00:00:00 GMT", "range": "bytes=0-9"}, 200),
        ("GET", {"if-range": OTHER_TAG}, 200),
        ("GET", {"if-modified-since": "Sun, 29 Nov 2026 00:00:00 GMT"}, 200),
        ("PUT", {"if-none-match": "*"}, 412),
        ("PUT", {"if-match": TAG}, 200),
        ("DELETE", {"if-match": OTHER_TAG}, 412),
        ("DELETE", {"if-match": TAG}, 204),
    ],
)
def test_a_condition_decides_whether_a_request_is_carried_out(
    service: Service, method: str, headers: dict[str, str], status: int
) -> None:
    service.ask("PUT", OBJECT, DATA)

    answer = service.ask(method, OBJECT, DATA if method == "PUT" else b"", headers=headers)

    assert answer.status == status
    if status == 304:
        assert (answer.headers["etag"], answer.body) == (TAG, b"")
        assert "content-length" not in answer.headers
    if method == "GET" and status in (200, 206):
        assert answer.body == (DATA if status == 200 else DATA[:10])
    if status == 412 and method != "HEAD":
        assert answer.json["hint"]
    assert service.ask("GET", OBJECT).status == (404 if status == 204 else 200)


@pytest.mark.parametrize(
    ("method", "name", "status"),
    [
        ("PUT", "if-none-match", 201),
        ("PUT", "if-match", 412),
        ("DELETE", "if-match", 412),
        ("GET", "if-match", 404),
    ],
)
def test_a_condition_of_an_object_that_does_not_exist(
    service: Service, method: str, name: str, status: int
) -> None:
    assert service.ask(method, OBJECT, DATA if method == "PUT" else b"", headers={name: "*"}).status == status


@pytest.mark.parametrize("asked", ["bytes=1024-", "bytes=5000-6000", "bytes=-0"])
def test_a_range_outside_the_object_is_refused_with_the_size(service: Service, asked: str) -> None:
    service.ask("PUT", OBJECT, DATA)

    answer = service.ask("GET", OBJECT, headers={"range": asked})

    assert (answer.status, answer.headers["content-range"]) == (416, "bytes */1024")


def test_a_list_comes_in_pages(service: Service) -> None:
    digests = sorted(digest_of(bytes([n])) for n in range(5))
    for n in range(5):
        service.ask("PUT", f"/data/v1/objects/{digest_of(bytes([n]))}", bytes([n]))

    first = service.ask("GET", "/data/v1/objects", query="limit=3").json
    second = service.ask("GET", "/data/v1/objects", query=f"limit=3&after={first['next']}").json

    assert [each["digest"] for each in first["objects"] + second["objects"]] == digests
    assert second["next"] is None
    assert service.ask("GET", "/data/v1/objects", query="limit=0").status == 400


def test_a_body_over_the_limit_is_refused_by_its_announcement_and_by_its_length(service: Service) -> None:
    large = b"x" * 4097
    path = f"/data/v1/objects/{digest_of(large)}"

    assert service.ask("PUT", path, large).status == 413
    announced = service.ask("PUT", path, b"", headers={"content-length": "99999999"})
    assert (announced.status, announced.headers["connection"]) == (413, "close")
    assert list(service.store.list("objects/")) == []


def test_a_slow_body_is_refused(service: Service) -> None:
    drops = [{"type": "http.request", "body": b"x", "more_body": True, "after_s": 2.0} for _ in range(9)]

    answer = service.ask("PUT", OBJECT, drops)

    assert answer.status == 408
    assert service.now == 6.0


def test_a_robot_that_disconnects_within_a_body_stores_nothing(service: Service) -> None:
    cut = [{"type": "http.request", "body": DATA[:9], "more_body": True}, {"type": "http.disconnect"}]

    service.ask("PUT", OBJECT, cut)

    assert list(service.store.list("objects/")) == []
    assert service.lines[-1]["status"] == "disconnected"


def test_the_quota_counts_objects_and_open_uploads(service: Service) -> None:
    for n in range(2):
        assert service.ask("PUT", f"/data/v1/uploads/{n:064d}", b'{"size": 20000}').status == 200
    for n in range(2):
        data = bytes([n]) * 4096
        assert service.ask("PUT", f"/data/v1/objects/{digest_of(data)}", data).status == 201

    over = service.ask("PUT", f"/data/v1/objects/{digest_of(b'y' * 4096)}", b"y" * 4096)
    assert (over.status, over.json["code"]) == (413, "quota")
    service.restart()
    assert service.ask("PUT", f"/data/v1/objects/{digest_of(b'y' * 4096)}", b"y" * 4096).status == 413
    assert service.ask("PUT", OBJECT, DATA, robot="robot-2").status == 201
    service.ask("DELETE", f"/data/v1/uploads/{0:064d}")
    assert service.ask("PUT", f"/data/v1/objects/{digest_of(b'y' * 4096)}", b"y" * 4096).status == 201


def test_a_robot_above_its_rate_gets_429_and_others_are_served() -> None:
    service = Service(small_settings(max_requests_per_s=0.5), MemoryStore())  # two at once

    statuses = [service.ask("HEAD", OBJECT).status for _ in range(3)]
    refused = service.ask("GET", OBJECT)

    assert statuses == [404] * 2 + [429]
    assert (refused.status, refused.json["code"]) == (429, "busy")
    assert refused.headers["retry-after"] == "2"
    assert service.ask("GET", OBJECT, robot="robot-2").status == 404
    service.now += 2.0
    assert service.ask("GET", OBJECT).status == 404


async def test_a_robot_that_repeats_a_body_without_a_place_comes_above_its_rate() -> None:
    service = Service(small_settings(max_requests_per_s=0.5, max_uploads=1), MemoryStore())
    held, done = asyncio.Event(), asyncio.Event()

    async def receive() -> dict[str, Any]:
        held.set()
        await done.wait()
        return {"type": "http.disconnect"}

    async def send(message: Mapping[str, Any]) -> None:
        raise AssertionError("nobody reads this")

    scope = {
        "type": "http", "method": "PUT", "path": OBJECT, "query_string": b"",
        "headers": [
            (b"authorization", f"Bearer {service.token('slow')}".encode()), (b"content-length", b"1024"),
        ],
    }  # fmt: skip
    holder = asyncio.ensure_future(service.app(scope, receive, send))
    await held.wait()

    began_s = service.now
    statuses = [(await asyncio.to_thread(service.ask, "PUT", OBJECT, DATA)).status for _ in range(4)]

    assert statuses == [503, 503, 429, 429]
    assert service.now - began_s == pytest.approx(4 * 0.25), "each refusal comes after a pause"
    done.set()
    await asyncio.wait([holder])


class SlowList(MemoryStore):
    """Stops within a list until it is let go."""

    def __init__(self) -> None:
        super().__init__()
        self.listed, self.gone = threading.Event(), threading.Event()
        self.read = 0

    def list(self, prefix: str = "", after: str = "") -> Iterator[ObjectInfo]:
        for self.read in range(1, 2000):
            yield ObjectInfo(name=f"{prefix}{self.read:064x}", size=1)
            self.listed.set()
            self.gone.wait(30)


async def test_work_ends_when_its_robot_closed_the_connection() -> None:
    store = SlowList()
    service = Service(small_settings(), store)

    async def receive() -> dict[str, Any]:
        raise AssertionError("it has no body")

    async def send(message: Mapping[str, Any]) -> None:
        raise AssertionError("nobody reads this")

    scope = {
        "type": "http", "method": "GET", "path": "/data/v1/objects", "query_string": b"",
        "headers": [(b"authorization", f"Bearer {service.token()}".encode())],
    }  # fmt: skip

    work = asyncio.ensure_future(service.app(scope, receive, send))
    await asyncio.to_thread(store.listed.wait, 30)
    work.cancel()  # as `OneRequestProtocol` does
    await asyncio.wait([work])
    store.gone.set()
    service.app.close()

    assert store.read == 2, "the work ends at the next object"
    assert service.lines[-1]["status"] == "disconnected"


def test_with_a_failing_store_the_service_is_alive_but_not_ready() -> None:
    service = Service(small_settings(), FakeStore(fail_with(StoreError("gone"), "head", "put")))

    assert service.ask("GET", "/data/readyz", token="").status == 503
    assert service.ask("GET", "/data/healthz", token="").status == 200


def test_a_defect_is_a_500_without_details(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service.store, "head", lambda name: 1 / 0)

    answer = service.ask("GET", OBJECT)

    assert answer.status == 500
    assert b"division" not in answer.body
    assert "division" in service.lines[-1]["error"]
    assert service.lines[-1]["trace"] in answer.json["hint"]


def test_a_wrong_method_is_405_with_the_allowed_ones(service: Service) -> None:
    answer = service.ask("POST", "/data/v1/objects")

    assert (answer.status, answer.headers["allow"]) == (405, "GET")


def test_the_log_contains_neither_token_nor_payload(service: Service) -> None:
    service.ask("PUT", OBJECT, b"secret-payload")

    assert "secret-payload" not in str(service.lines)
    assert service.token() not in str(service.lines)
    assert service.lines[-1]["robot"] == "robot-1"


WORDS = st.text(max_size=80) | st.sampled_from(
    ["..", "../../etc/passwd", "%2e%2e", "\x00", "a" * 5000, "/", "//", "\\", "CON", ".lock-x", "\ud800"]
)
HOSTILE_ROBOTS = st.sampled_from(["../../etc", "/etc/passwd", "..", ".", "a/b", "~", "x=" + "0" * 62])
PATHS = st.builds(
    lambda kind, words, tail: f"/data/v1/{kind}/" + "/".join(words) + tail,
    st.sampled_from(["objects", "uploads", "maps", "maps/a/versions", ".."]),
    st.lists(WORDS, max_size=4),
    st.sampled_from(["", "/versions", "/head", "/content"]),
)


def files_below(folder: Path) -> set[str]:
    return {
        os.path.relpath(os.path.join(at, name), folder) for at, _, names in os.walk(folder) for name in names
    }


@pytest.mark.slow
@pytest.mark.timeout(1200)
@hypothesis_settings(
    max_examples=int(os.environ.get("RSE_PF_HOSTILE_NAMES", "1000")),
    suppress_health_check=[HealthCheck.too_slow],
)
@given(
    method=st.sampled_from(["GET", "PUT", "PATCH", "POST", "DELETE", "HEAD"]),
    path=PATHS,
    robot=st.text(min_size=1, max_size=64).filter(lambda text: text.isprintable()) | HOSTILE_ROBOTS,
    body=st.binary(max_size=64) | st.sampled_from([b'{"size": 5}', b'{"digest": "' + b"0" * 64 + b'"}']),
)
def test_no_name_leaves_the_store_and_none_breaks_the_server(
    method: str, path: str, robot: str, body: bytes
) -> None:
    with tempfile.TemporaryDirectory() as made:
        above = Path(made)
        service = Service(SMALL, DirectoryStore(above / "in" / "store"))

        answer = service.ask(method, path, body, robot=robot, headers={"upload-offset": "0"})
        stored = service.ask("PUT", f"/data/v1/objects/{digest_of(body)}", body, robot=robot)

        assert 200 <= answer.status < 500
        assert stored.status == 201
        found = files_below(above)
        assert {tuple(name.split("/")[:3]) for name in found} <= {
            ("in", "store", "accounts"),
            ("in", "store", "objects"),
            ("in", "store", "uploads"),
        }
        assert len([name for name in found if not name.startswith("in/store/accounts/")]) <= 2
