"""T23: two requests in one.  Each sample is refused or means one thing to everybody who reads it.

The samples go to a backend server, to the data service, and through the real load balancer to a server that
writes down what reaches it.  After each one, others ask: who gets an answer that is not theirs has found a
hole.  Nothing waits for time: what a sample does is over when questions that came later are answered.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import time
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.local.balancer.envoy_config import DATA_CLUSTER, Target
from rse_pf.local.balancer.load_balancer import EnvoyLoadBalancer
from rse_pf.server.gateway.rate_limits import SourceRates
from tests.kit.data_process import DataProcess
from tests.kit.guarded_server import GuardedServer
from tests.kit.smuggling_samples import HIDDEN, REFUSED, SAMPLES, put, upgrade

pytestmark = pytest.mark.system

ONE_HANDSHAKE = {
    "ws: two hosts", "ws: no host", "ws: host with a path", "ws: CL with an underscore",
    "request right after an upgrade", "upgrade right after an upgrade",
}  # fmt: skip
"""What a server takes for a handshake: it asks for no host, and what follows is no good frame."""
SOON_S = 30.0
FENCES = 3
STATUS = re.compile(rb"HTTP/1\.[01] (\d{3})")
CONTROLS = re.compile(rb"[\x00-\x08\x0a-\x1f\x7f]")

Fence = Callable[[int], Awaitable[None]]


async def heard(port: int, data: bytes, fence: Fence) -> bytes:
    """Return everything that *data* was answered with when *fence*, asked afterwards, was answered too."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(data)
        with contextlib.suppress(ConnectionError):
            await writer.drain()
        for number in range(FENCES):
            await fence(number)
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        return bytes(reader._buffer)  # type: ignore[attr-defined]
    finally:
        writer.transport.abort()


async def answer_to(port: int, request: bytes) -> bytes:
    """Return head and body of the answer to an honest request."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    try:
        writer.write(request)
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), SOON_S)
        size = re.search(rb"(?i)\r\ncontent-length: (\d+)\r\n", head)
        body = await asyncio.wait_for(reader.readexactly(int(size[1]) if size else 0), SOON_S)
        return head + body
    finally:
        writer.transport.abort()


# --- servers, asked directly -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GuardedServer]:
    with GuardedServer(tmp_path_factory.mktemp("guarded"), workers=1) as server:
        yield server


@pytest.mark.parametrize("token", ["good", "bad"])
async def test_a_backend_server_never_answers_twice(server: GuardedServer, token: str) -> None:
    carried = server.token("robot-1").encode() if token == "good" else b"x"

    async def fence(_: int) -> None:
        assert b" 401 " in await answer_to(server.port, upgrade())

    answers = {
        name: STATUS.findall(await heard(server.port, data.replace(b"TOKEN", carried), fence))
        for name, data in SAMPLES.items()
    }

    assert {name: codes for name, codes in answers.items() if len(codes) > 1} == {}
    opened = {name for name, codes in answers.items() if codes == [b"101"]}
    assert opened == (ONE_HANDSHAKE if token == "good" else set())
    assert '"defect"' not in server.log


@pytest.fixture(scope="module")
def data_port(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The port of a data service."""
    with DataProcess(tmp_path_factory.mktemp("data")) as service:
        yield service.port


async def test_the_data_service_never_answers_twice(data_port: int) -> None:
    async def fence(_: int) -> None:
        assert b" 401 " in await answer_to(data_port, put(b"Content-Length: 0"))

    answers = {name: STATUS.findall(await heard(data_port, data, fence)) for name, data in SAMPLES.items()}

    assert {name: codes for name, codes in answers.items() if len(codes) > 1} == {}
    assert not [name for name, codes in answers.items() if codes and int(codes[0]) < 400]


async def test_the_data_service_keeps_a_connection_whose_client_waits_for_answers(data_port: int) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", data_port)
    codes = []
    for _ in range(3):
        writer.write(b"GET /data/healthz HTTP/1.1\r\nHost: x\r\n\r\n")
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), SOON_S)
        size = re.search(rb"(?i)content-length: (\d+)", head)
        await asyncio.wait_for(reader.readexactly(int(size[1]) if size else 0), SOON_S)
        codes += STATUS.findall(head)
    writer.transport.abort()
    assert codes == [b"200"] * 3


# --- through the load balancer ---------------------------------------------------------------------


@dataclass
class Recorder:
    """A server that keeps connections, writes down each request, and says in its answer what was asked."""

    opens: bool
    requests: list[tuple[bytes, bytes]] = field(default_factory=list)
    rest: list[bytes] = field(default_factory=list)

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while True:
                head = await reader.readuntil(b"\r\n\r\n")
                asked = head.split(b" ", 2)[1]
                if asked.endswith(b"z"):  # a health check
                    writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n")
                    continue
                if b"upgrade: websocket" in head.lower() and self.opens and HIDDEN not in asked:
                    self.requests.append((head, b""))
                    writer.write(b"HTTP/1.1 101 Yes\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\r\n")
                    await reader.read()  # frames, to a real server
                    return
                self.requests.append((head, await self._body(head, reader)))
                writer.write(b"HTTP/1.1 401 No\r\nContent-Length: %d\r\n\r\n%s" % (len(asked), asked))
        except asyncio.IncompleteReadError as error:
            if error.partial:
                self.rest.append(error.partial)
        except (ConnectionError, asyncio.CancelledError):
            pass
        finally:
            writer.close()

    async def _body(self, head: bytes, reader: asyncio.StreamReader) -> bytes:
        size = re.search(rb"(?i)\r\ncontent-length: (\d+)\r\n", head)
        if b"\r\ntransfer-encoding:" not in head.lower():
            return await reader.readexactly(int(size[1]) if size else 0)
        body = b""
        while True:
            count = int(await reader.readuntil(b"\r\n"), 16)
            body += (await reader.readexactly(count + 2))[:-2]
            if not count:
                return body


def ambiguities(head: bytes) -> list[str]:
    """Return why two readers might understand the head of a request differently."""
    lines = head.removesuffix(b"\r\n\r\n").split(b"\r\n")
    names = [line.partition(b":")[0].lower() for line in lines[1:]]
    values = {name: line.partition(b":")[2].strip() for name, line in zip(names, lines[1:], strict=True)}
    found = {
        "start line": not re.fullmatch(rb"[A-Z]+ /[!-~]* HTTP/1\.1", lines[0]),
        "control letter": any(CONTROLS.search(line) for line in lines),
        "folded": any(line[:1] in b" \t" for line in lines),
        "name": any(not re.fullmatch(rb"[a-z0-9-]+", name) for name in names),
        "hosts": names.count(b"host") != 1,
        "two lengths": names.count(b"content-length") + names.count(b"transfer-encoding") > 1,
        "length": not re.fullmatch(rb"[0-9]{1,18}", values.get(b"content-length", b"0")),
        "encoding": values.get(b"transfer-encoding", b"chunked") != b"chunked",
    }
    return [what for what, is_so in found.items() if is_so]


@dataclass
class Told:
    """What one sample did behind the load balancer."""

    codes: list[bytes]
    requests: list[tuple[bytes, bytes]]
    own: bool


async def through_the_load_balancer(folder: Path, *, opens: bool) -> tuple[dict[str, Told], list[bytes]]:
    """Send every sample through a real Envoy; after each one, others ask for what is theirs."""
    recorder = Recorder(opens)
    upstream = await asyncio.start_server(recorder.serve, "127.0.0.1", 0)
    port = upstream.sockets[0].getsockname()[1]
    balancer = EnvoyLoadBalancer(PlatformSettings(), folder=folder, port=0)
    balancer.launch()
    try:
        await balancer.wait_live(SOON_S)
        balancer.set_targets([Target(name="robots", port=port, control_port=port)])
        balancer.set_targets([Target(name="data", port=port, control_port=port)], DATA_CLUSTER)
        assert await balancer.wait_healthy(["robots"], SOON_S)
        end = time.monotonic() + SOON_S
        while b" 401 " not in await answer_to(balancer.port, put(b"Content-Length: 0")):
            assert time.monotonic() < end
        told = {}
        for name, data in SAMPLES.items():
            recorder.requests.clear()
            got: list[bytes] = []

            async def fence(number: int, got: list[bytes] = got) -> None:
                for path in (b"/ws?fence%d" % number, b"/data/fence%d" % number):
                    honest = b"GET " + path + b" HTTP/1.1\r\nHost: x\r\n\r\n"
                    answer = await answer_to(balancer.port, honest)
                    end = time.monotonic() + SOON_S
                    # Envoy itself, while a health check of the busy test was late: nobody's answer.
                    while answer.startswith(b"HTTP/1.1 503 ") and time.monotonic() < end:
                        answer = await answer_to(balancer.port, honest)
                    got.append(answer.rpartition(b"\n")[2])

            codes = STATUS.findall(await heard(balancer.port, data, fence))
            asked = [b"%s%d" % (path, n) for n in range(FENCES) for path in (b"/ws?fence", b"/data/fence")]
            seen = [each for each in recorder.requests if b"fence" not in each[0].split(b" ", 2)[1]]
            told[name] = Told(codes, seen, got == asked)
        return told, recorder.rest
    finally:
        balancer.kill()
        upstream.close()


@pytest.mark.parametrize("opens", [False, True])
def test_a_request_that_passes_the_load_balancer_is_read_alike_by_all_servers(
    tmp_path: Path, opens: bool
) -> None:
    told, _ = asyncio.run(through_the_load_balancer(tmp_path, opens=opens))

    unclear = {
        name: found
        for name, each in told.items()
        if (found := [what for head, _ in each.requests for what in ambiguities(head)])
    }
    assert unclear == {}, "two readers may understand these differently"
    assert [name for name, each in told.items() if not each.own] == [], "somebody got another's answer"
    handed_on = {name for name in REFUSED if told[name].requests}
    assert handed_on == set(), "these are no requests"
    assert {name for name in REFUSED if any(int(code) < 400 for code in told[name].codes)} == set()
    unseen = {
        name
        for name, each in told.items()
        if len(each.requests) > 1 and len(each.codes) != len(each.requests)
    }
    assert unseen == set(), "a server answered a request that the load balancer has not seen as one"
    after_upgrade = {name for name in SAMPLES if "websocket" in SAMPLES[name].decode("latin-1")}
    assert {name for name in after_upgrade if len(told[name].requests) > 1} == set()


FORGED = (
    b"X-Forwarded-For: 10.9.9.9",
    b"X-Forwarded-For: 10.9.9.9, 10.9.9.8",
    b"X-Forwarded-For: 10.9.9.9\r\nX-Forwarded-For: 10.9.9.8",
    b"x-forwarded-for: 10.9.9.9",
    b"X-Forwarded-For: ,,,",
    b"X-Forwarded-For: " + b"10.9.9.9," * 500,
    b"X-Forwarded-For: 10.9.9.9,\t",
    b"X-Envoy-External-Address: 10.9.9.9",
    b"X-Real-IP: 10.9.9.9",
    b"Forwarded: for=10.9.9.9",
    b"X_Forwarded_For: 10.9.9.9",
)
"""Lines by which a robot says that it is somebody else."""


async def test_no_robot_chooses_the_address_that_its_handshakes_count_for(tmp_path: Path) -> None:
    recorder = Recorder(opens=False)
    upstream = await asyncio.start_server(recorder.serve, "127.0.0.1", 0)
    port = upstream.sockets[0].getsockname()[1]
    balancer = EnvoyLoadBalancer(PlatformSettings(), folder=tmp_path, port=0)
    balancer.launch()
    sources = {}
    try:
        await balancer.wait_live(SOON_S)
        balancer.set_targets([Target(name="robots", port=port, control_port=port)])
        assert await balancer.wait_healthy(["robots"], SOON_S)
        for line in FORGED:
            recorder.requests.clear()
            await answer_to(balancer.port, b"GET /ws HTTP/1.1\r\nHost: x\r\n" + line + b"\r\n\r\n")
            heads = [head.decode("latin-1").lower() for head, _ in recorder.requests]
            told = [",".join(re.findall(r"\r\nx-forwarded-for: ([^\r]*)", head)) for head in heads]
            rates = SourceRates(PlatformSettings().serving)
            sources[line] = ",".join(rates.source("the balancer", each) for each in told)
    finally:
        balancer.kill()
        upstream.close()

    (own,) = {source for source in sources.values() if source}  # Envoy names an address of this machine
    assert own not in ("the balancer", "")
    assert not own.startswith("10.9.9.")
    assert [line for line, source in sources.items() if not source] == [b"X_Forwarded_For: 10.9.9.9"], (
        "refused"
    )
