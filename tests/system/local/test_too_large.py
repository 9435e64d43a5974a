"""A body that is too large gets its 413 also in a client that is already sending."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import shutil
import socket
import subprocess
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.local.control.platform import LocalPlatform

pytestmark = [pytest.mark.system, pytest.mark.slow, pytest.mark.timeout(300)]

MIB = 1 << 20
SETTINGS = PlatformSettings()
OBJECT = "/data/v1/objects/" + "a" * 64
TIMES = 5


def sent_first(address: tuple[str, int], size: int, token: str) -> tuple[int, str]:
    """Send all of a body, and read the answer then, as httpx does; a write that fails ends the sending."""
    with socket.create_connection(address, timeout=20) as connection:
        head = f"PUT {OBJECT} HTTP/1.1\r\nHost: a\r\nAuthorization: Bearer {token}\r\n"
        head += f"Content-Length: {size}\r\n\r\n"
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            connection.sendall(head.encode())
            for _ in range(size // MIB):
                connection.sendall(b"x" * MIB)
        answer = b""
        while piece := connection.recv(65536):
            answer += piece
            found, _, body = answer.partition(b"\r\n\r\n")
            if body.endswith(b"}"):
                return int(found.split()[1]), json.loads(body)["code"]
        raise AssertionError(f"no whole answer: {answer!r}")


def by_http_client(address: tuple[str, int], size: int, token: str) -> tuple[int, str]:
    """Send all of a body, and read the answer then; a write that fails is an error."""
    connection = http.client.HTTPConnection(*address, timeout=20)
    connection.request("PUT", OBJECT, bytes(size), {"Authorization": f"Bearer {token}"})
    reply = connection.getresponse()
    code = json.loads(reply.read())["code"]
    connection.close()
    return reply.status, code


def by_curl(address: tuple[str, int], size: int, token: str) -> tuple[int, str]:
    curl = shutil.which("curl") or pytest.skip("no curl")
    done = subprocess.run(
        [curl, "-sS", "-X", "PUT", "--data-binary", "@-", "-w", "\n%{http_code}", "-H", "Expect:",
         "-H", f"Authorization: Bearer {token}", f"http://{address[0]}:{address[1]}{OBJECT}"],
        input=b"x" * size, capture_output=True, check=False, timeout=60,
    )  # fmt: skip
    body, _, status = done.stdout.decode().rpartition("\n")
    assert body, done.stderr
    return int(status), json.loads(body)["code"]


CPP_PROGRAM = """
#include <cstdio>
#include <rse_pf/data.hpp>
int main(int, char** given) {
    rse_pf::DataOptions options;
    options.part_bytes = std::size_t{1} << 30;  // all in one request
    rse_pf::DataClient data(std::string("http://") + given[1], given[2], options);
    try {
        data.upload(std::string(std::stoul(given[3]), 'x'));
    } catch (const rse_pf::Error& error) {
        std::printf("%s", error.code().c_str());
    }
}
"""
HEADERS = ("boost/beast/websocket.hpp", "nlohmann/json.hpp", "openssl/ssl.h")


@pytest.fixture(scope="module")
def cpp_program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A program of the C++ client that stores so many bytes at once, and prints the code of its error."""
    compiler = shutil.which("c++") or pytest.skip("no C++ compiler")
    include = Path(__file__).resolve().parents[3] / "client_cpp" / "include"
    for header in HEADERS:
        is_there = subprocess.run(
            [compiler, "-E", "-x", "c++", "-"], input=f"#include <{header}>", text=True, capture_output=True,
            check=False,
        )  # fmt: skip
        if is_there.returncode != 0:
            pytest.skip(f"no {header}: sh scripts/client_cpp.sh names the packages")
    folder = tmp_path_factory.mktemp("cpp")
    (folder / "store.cpp").write_text(CPP_PROGRAM)
    words = [compiler, "-std=c++17", f"-I{include}", "store.cpp", "-o", "store", "-pthread"]
    subprocess.run([*words, "-lssl", "-lcrypto"], cwd=folder, check=True, timeout=300)
    return folder / "store"


def data_port(folder: Path) -> int:
    (announced,) = folder.glob("data-[0-9]*.json")
    return int(json.loads(announced.read_text())["port"])


async def test_the_answer_arrives_directly_and_through_the_balancer(tmp_path: Path) -> None:
    state = tmp_path / "a"
    async with LocalPlatform(SETTINGS, servers=1, port=0, state=state, data=True) as platform:
        balancer = urlsplit(platform.url)
        for address in ((balancer.hostname or "", balancer.port or 0), ("127.0.0.1", data_port(state))):
            sizes = {sent_first: (5, 60), by_curl: (5, 60), by_http_client: (5, 12, 30)}
            for send, size_mib in ((send, size) for send, each in sizes.items() for size in each):
                for number in range(TIMES):
                    # What is refused counts, so one robot would soon be told to wait instead.
                    token = platform.issue_token(f"{send.__name__}-{size_mib}-{number}".replace("_", "-"))
                    answer = await asyncio.to_thread(send, address, size_mib * MIB, token)
                    assert answer == (413, "too-large"), (address, send, size_mib)


async def test_the_cpp_client_has_the_answer_directly_and_through_the_balancer(
    tmp_path: Path, cpp_program: Path
) -> None:
    state = tmp_path / "a"
    async with LocalPlatform(SETTINGS, servers=1, port=0, state=state, data=True) as platform:
        token = platform.issue_token("robot-1")
        for address in (urlsplit(platform.url).netloc, f"127.0.0.1:{data_port(state)}"):
            for size in (5 * MIB, 60 * MIB):
                for _ in range(TIMES):
                    done = await asyncio.to_thread(
                        subprocess.run, [cpp_program, address, token, str(size)], capture_output=True,
                        text=True, timeout=60, check=True,
                    )  # fmt: skip
                    assert done.stdout == "too-large", (address, size)
