"""Bodies that are slow, huge or never come: other robots are served, and memory stays small."""

from __future__ import annotations

import hashlib
import http.client
import itertools
import select
import socket
from collections.abc import Iterator

import pytest

from tests.kit.data_process import DataProcess

pytestmark = pytest.mark.system

MAX_BODIES = 8  # of which a robot may have 2 and a tenant 6
SOON_S = 30.0
_NUMBERS = itertools.count()


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DataProcess]:
    with DataProcess(tmp_path_factory.mktemp("data"), max_uploads=MAX_BODIES) as service:
        yield service


def put(service: DataProcess, robot: str, tenant: str) -> tuple[int, str | None]:
    """Store a small object; return the status and the header that says when to come back."""
    data = b"object %d" % next(_NUMBERS)
    connection = http.client.HTTPConnection("127.0.0.1", service.port, timeout=SOON_S)
    try:
        headers = {"Authorization": f"Bearer {service.token(robot, tenant)}"}
        connection.request("PUT", f"/data/v1/objects/{hashlib.sha256(data).hexdigest()}", data, headers)
        reply = connection.getresponse()
        reply.read()
        return reply.status, reply.getheader("Retry-After")
    finally:
        connection.close()


def begin_body(service: DataProcess, authorization: str, size: int = 1 << 20) -> socket.socket:
    """Announce a body of *size* bytes, and send the first one."""
    connection = socket.create_connection(("127.0.0.1", service.port), timeout=SOON_S)
    head = f"PUT /data/v1/objects/{'a' * 64} HTTP/1.1\r\nHost: x\r\n{authorization}"
    connection.sendall(f"{head}Content-Length: {size}\r\n\r\nx".encode())
    return connection


def slow_bodies(service: DataProcess, tenant: str, robots: int, each: int) -> list[socket.socket]:
    """Take *each* places for each of so many robots with bodies that do not go on."""
    tokens = [service.token(f"slow-{number}", tenant) for number in range(robots)]
    return [
        begin_body(service, f"Authorization: Bearer {token}\r\n") for token in tokens for _ in range(each)
    ]


@pytest.mark.parametrize(
    ("asking", "holding"), [("third", {"first": 3, "second": 1}), ("first", {"first": 3})]
)
def test_the_slowest_body_gives_up_its_place_to_who_has_fewer(
    service: DataProcess, asking: str, holding: dict[str, int]
) -> None:
    slow = [each for tenant, robots in holding.items() for each in slow_bodies(service, tenant, robots, 2)]

    assert [put(service, f"robot-{number}", asking)[0] for number in range(4)] == [201] * 4

    ended, _, _ = select.select(slow, [], [], SOON_S)
    assert len(ended) == 1, "who asks one after the other needs one place"
    answer = ended[0].recv(4096)
    assert answer.startswith(b"HTTP/1.1 503 ")
    assert b"retry-after: 1\r\n" in answer
    for each in slow:
        each.close()


@pytest.mark.parametrize("size_mib", [5, 12, 30])
def test_a_body_that_is_too_long_is_answered_when_it_was_sent(service: DataProcess, size_mib: int) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", service.port, timeout=SOON_S)
    headers = {"Authorization": f"Bearer {service.token(f'large-{size_mib}')}"}
    connection.request("PUT", f"/data/v1/objects/{'a' * 64}", bytes(size_mib << 20), headers)
    assert connection.getresponse().status == 413
    connection.close()


def test_a_client_that_has_the_last_byte_may_ask_again_at_once(service: DataProcess) -> None:
    data, token = bytes(3 << 20), service.token("reader")  # a reply in several pieces
    path, headers = (
        f"/data/v1/objects/{hashlib.sha256(data).hexdigest()}",
        {"Authorization": f"Bearer {token}"},
    )
    connection = http.client.HTTPConnection("127.0.0.1", service.port, timeout=SOON_S)
    connection.request("PUT", path, data, headers)
    assert connection.getresponse().read()
    first = connection.sock
    for _ in range(5):
        connection.request("GET", path, headers=headers)
        assert connection.getresponse().read() == data
    assert connection.sock is first, "it was connected anew"
    connection.close()
