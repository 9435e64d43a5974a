"""A robot or data client that cannot connect names the machine that answered, and an action that helps."""

from __future__ import annotations

import asyncio
import socket
import ssl
import threading
import time
from dataclasses import dataclass, replace
from urllib.parse import urlsplit

import pytest
from fake_peers import after_request, at_once, http, peer, read_head, silent, tls_context, with_tls

import client_sdk
from client_sdk.network.connect_timings import ConnectTimings
from client_sdk.network.peer_probe import probe_peer
from client_sdk.transfer.data_client import DataClient, DataOptions
from rse_pf.auth import certificates
from rse_pf.auth.certificates import AUTHORITY_S, CertificateWithKey, make_authority
from rse_pf.errors import ConnectError, RsePfError, UsageError
from rse_pf.wire.refusal import refusal_body

TIMINGS = ConnectTimings(connect_timeout_s=1.0, reconnect_max_s=0.01)
OPTIONS = DataOptions(timeout_s=1.0, deadline_s=0.5, first_pause_s=0.01)
NGINX_404 = http("404 Not Found\r\nServer: nginx/1.24.0\r\nContent-Type: text/html", "<h1>404</h1>")
PORTAL = "<html><title>Guest Wi-Fi</title><form>Password: <input></form></html>"


@dataclass(frozen=True)
class Case:
    """Bytes that a peer answers with, and parts of the message and the hint that the error must have."""

    name: str
    answer: bytes
    message: str
    hint: str


HTML = "200 OK\r\nContent-Type: text/html"
HTTP_CASES = [
    Case("login page", http(HTML, PORTAL), "login page 'Guest Wi-Fi'", "log in"),
    Case("login page by script", http(HTML, "<html></html>"), "web page", "log in"),
    Case("redirect", http("302 Found\r\nLocation: http://a.example/in?x=1"), "login page", "a.example/in "),
    Case("relative redirect", http("303 See Other\r\nLocation: /login"), "login page", "/login"),
    Case("redirect in 1.0", http("302 Found\r\nLocation: http://a.example/", version="1.0"), "302", "log in"),
    Case("proxy", http("407 Proxy Authentication Required"), "407", "HTTP_PROXY=http://USER:PASSWORD@"),
    Case("network login", http("511 Network Authentication Required"), "login", "log in"),
    Case("nginx", NGINX_404, "'nginx/1.24.0'", "no RSE-PF server"),
    Case("TLS of nginx", http("400 Bad Request", "plain HTTP request sent to HTTPS port"), "TLS", "s://"),
    Case("TLS of Go", http("400 Bad Request", "request to an HTTPS server", version="1.0"), "TLS", "s://"),
    Case("TLS by redirect", http("301 x\r\nLocation: https://127.0.0.1/a"), "https://127.0.0.1/a", "s://127.0"),
    Case("text", http("200 OK\r\nContent-Type: text/plain", "MongoDB"), "text/plain", "host and port"),
    Case("gateway", http("502 Bad Gateway"), "reaches no server", "servers of the platform run"),
    Case("firewall", http("403 Forbidden\r\nContent-Type: text/html"), "not an RSE-PF server", "firewall"),
]  # fmt: skip
WEBSOCKET_CASES = [
    Case("page in 1.0", http(HTML, PORTAL, version="1.0"), "HTTP/1.0", "log in"),
    Case("http.server", http("404 File not found", version="1.0"), "404 Not Found in HTTP/1.0", "host and"),
    Case("full", http("503 Service Unavailable\r\nRetry-After: 1"), "is full, or is", "try again in 1 s"),
    Case("starting", http("503 Service Unavailable"), "is full, or is starting", "try again later"),
    Case("no upgrade", http("426 Upgrade Required"), "removed the header Upgrade", "Upgrade and Connection"),
    Case("no upgrade at ours", http("400 Bad Request", refusal_body("bad-message", "no", "").decode()),
         "removed the header Upgrade", "Upgrade and Connection"),
    Case("JSON", http("200 OK\r\nContent-Type: application/json", "{}"), "application/json", "host and"),
]  # fmt: skip
BANNERS = [
    Case("ssh", b"SSH-2.0-OpenSSH_9.2p1 Debian\r\n", "'SSH-2.0-OpenSSH_9.2p1 Debian'", "no RSE-PF server"),
    Case("database", b"\x4a\0\0\0\x0a8.0.36\0\x08\0\0\0", "8.0.36", "no RSE-PF server"),
    Case("cache", b"-ERR unknown command\r\n", "-ERR unknown command", "no RSE-PF server"),
    Case("TLS alert", b"\x15\x03\x01\x00\x02\x02\x46", "speaks TLS", "s://"),
]


@pytest.fixture(autouse=True)
def no_proxy(monkeypatch):
    for name in ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.lower(), raising=False)


async def robot_error(url: str) -> RsePfError:
    with pytest.raises(RsePfError) as raised:
        async with client_sdk.connect(url, token="t", timings=TIMINGS):
            pass
    return one_line(raised.value)


def data_error(url: str) -> RsePfError:
    with pytest.raises(RsePfError) as raised:
        DataClient(url, "t", OPTIONS).upload(b"x")
    return one_line(raised.value)


def one_line(error: RsePfError) -> RsePfError:
    assert error.hint
    assert (error.message + error.hint).isprintable()
    return error


def shows(error: RsePfError, case: Case) -> None:
    assert isinstance(error, ConnectError)
    assert case.message in error.message
    assert case.hint in error.hint


@pytest.mark.parametrize("case", [*HTTP_CASES, *WEBSOCKET_CASES, *BANNERS], ids=lambda case: case.name)
async def test_a_robot_names_what_answered(case):
    serve = at_once(case.answer) if case in BANNERS else after_request(case.answer)
    with peer(serve) as port:
        shows(await robot_error(f"ws://127.0.0.1:{port}/ws"), case)


@pytest.mark.parametrize("case", [*HTTP_CASES, *BANNERS], ids=lambda case: case.name)
def test_a_data_client_names_what_answered_and_never_takes_it_for_success(case):
    serve = at_once(case.answer) if case in BANNERS else after_request(case.answer)
    with peer(serve) as port:
        shows(data_error(f"http://127.0.0.1:{port}"), case)


@pytest.mark.parametrize("case", BANNERS[:3], ids=lambda case: case.name)
async def test_another_program_is_named_where_tls_was_expected(case):
    with peer(at_once(case.answer)) as port:
        shows(await robot_error(f"wss://127.0.0.1:{port}/ws"), case)
        shows(data_error(f"https://127.0.0.1:{port}"), case)


@pytest.mark.parametrize("answer", [NGINX_404, http("400 Bad Request"), http("200 OK", version="1.0")])
async def test_a_secure_address_of_a_server_without_tls(answer):
    with peer(after_request(answer)) as port:
        for error in (
            await robot_error(f"wss://127.0.0.1:{port}/ws"),
            data_error(f"https://127.0.0.1:{port}"),
        ):
            assert "speaks HTTP without TLS" in error.message
            assert error.hint.startswith(("write ws://", "write http://"))


@pytest.fixture(scope="module")
def authority() -> CertificateWithKey:
    return make_authority("acme", now_s=time.time())


async def test_a_plain_address_of_a_server_with_tls(authority, tmp_path):
    context = tls_context(authority, ["127.0.0.1"], tmp_path, time.time())
    with peer(with_tls(context, after_request(NGINX_404))) as port:
        for error in (await robot_error(f"ws://127.0.0.1:{port}/ws"), data_error(f"http://127.0.0.1:{port}")):
            assert "speaks TLS" in error.message
            assert error.hint in ("write wss:// in the URL", "write https:// in the URL")


@pytest.mark.parametrize(
    ("issuer", "hint"),
    [
        ("RSE-PF authority of platform acme", "enrol again with --authority"),
        ("ACME Root", "--authority"),
        ("ACME Web Proxy CA", "set SSL_CERT_FILE to the certificate of 'ACME Web Proxy CA'"),
    ],
)
async def test_a_certificate_of_an_unknown_authority_is_shown_with_its_issuer(
    issuer, hint, tmp_path, monkeypatch
):
    subject = certificates._subject
    monkeypatch.setattr(
        certificates, "_subject", lambda name: subject(issuer if name.startswith("RSE-PF auth") else name)
    )
    made = make_authority("acme", now_s=time.time())
    context = tls_context(made, ["127.0.0.1"], tmp_path, time.time())
    with peer(with_tls(context, after_request(NGINX_404))) as port:
        for error in (
            await robot_error(f"wss://127.0.0.1:{port}/ws"),
            data_error(f"https://127.0.0.1:{port}"),
        ):
            assert f"by {issuer!r}" in error.message
            assert hint in error.hint


async def test_an_enrolled_robot_is_shown_the_issuer_that_is_not_the_one_of_its_file(authority, tmp_path):
    context = tls_context(authority, ["127.0.0.1"], tmp_path, time.time())
    other = ssl.create_default_context(cadata=make_authority("other", now_s=time.time()).certificate)
    with peer(with_tls(context, after_request(NGINX_404))) as port, pytest.raises(ConnectError) as raised:
        DataClient(f"https://127.0.0.1:{port}", "t", replace(OPTIONS, ssl_context=other)).upload(b"x")
    assert "RSE-PF authority of platform acme" in raised.value.message
    assert "enrol again" in raised.value.hint


@pytest.mark.parametrize(
    ("names", "made_s", "hint"),
    [(["10.9.9.9"], 0.0, "host name in the URL"), (["127.0.0.1"], -AUTHORITY_S / 2, "clock")],
)
def test_a_certificate_of_another_host_or_another_time(names, made_s, hint, authority, tmp_path):
    context = tls_context(authority, names, tmp_path, time.time() + made_s)
    trusting = ssl.create_default_context(cadata=authority.certificate)
    with peer(with_tls(context, after_request(NGINX_404))) as port, pytest.raises(ConnectError) as raised:
        DataClient(f"https://127.0.0.1:{port}", "t", replace(OPTIONS, ssl_context=trusting)).upload(b"x")
    assert hint in raised.value.hint


async def test_a_peer_that_sends_nothing():
    with peer(silent) as port:
        error = await robot_error(f"ws://127.0.0.1:{port}/ws")
    assert "sends no answer within 1 s, as a program of another protocol does" in error.message
    assert "host and port" in error.hint


@pytest.mark.parametrize("has_proxy", [False, True])
def test_a_peer_that_never_stops_sending_slowly_ends_no_later_than_a_silent_one(has_proxy, monkeypatch):
    def trickle(made: socket.socket) -> None:
        for _ in range(200):
            made.sendall(b"x")
            threading.Event().wait(0.05)

    with peer(trickle) as port:
        if has_proxy:
            monkeypatch.setenv("HTTPS_PROXY", f"http://127.0.0.1:{port}")
            monkeypatch.setenv("HTTP_PROXY", f"http://127.0.0.1:{port}")
        began = time.monotonic()
        probed = probe_peer(
            urlsplit("ws://robots.invalid/ws" if has_proxy else f"ws://127.0.0.1:{port}/ws"), 0.3
        )
    assert probed.certificate is None
    assert time.monotonic() - began < 5.0


async def test_a_server_that_answers_only_when_it_is_asked_again_is_slow():
    for ask in (robot_error, lambda url: asyncio.to_thread(data_error, url.replace("ws:", "http:"))):
        requests = []

        def answer_late(made: socket.socket, requests: list[bytes] = requests) -> None:
            head = read_head(made)
            requests.append(head)
            if b"Authorization" in head:
                silent(made)
            elif head.startswith(b"GET"):
                made.sendall(http("426 Upgrade Required"))

        with peer(answer_late) as port:
            error = await ask(f"ws://127.0.0.1:{port}/ws")
        assert "sends no answer within 1 s" in error.message
        assert error.hint == "try again; see the load of the server"


async def test_a_peer_that_closes_without_a_word():
    with peer(after_request(b"")) as port:
        for error in (await robot_error(f"ws://127.0.0.1:{port}/ws"), data_error(f"http://127.0.0.1:{port}")):
            assert "closed the connection without an answer" in error.message


async def test_a_name_that_does_not_resolve():
    for error in (await robot_error("ws://robots.invalid/ws"), data_error("http://robots.invalid")):
        assert "the name robots.invalid does not resolve" in error.message
        assert "name server" in error.hint


@pytest.mark.parametrize("host", ["a..b", "a." + 64 * "b", ".a", "[::1", "a:port", ""])
def test_an_address_that_cannot_be_one_is_a_usage_error_of_the_constructor(host):
    with pytest.raises(UsageError, match="is not a WebSocket address"):
        client_sdk.connect(f"ws://{host}/ws")
    with pytest.raises(UsageError, match="is not an address of a data service"):
        DataClient(f"http://{host}", "t")
