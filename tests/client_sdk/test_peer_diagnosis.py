"""A robot or data client that cannot connect names the machine that answered, and an action that helps."""

from __future__ import annotations

import ssl
import time
from dataclasses import dataclass, replace

import pytest

import client_sdk
from client_sdk.network.connect_timings import ConnectTimings
from client_sdk.transfer.data_client import DataClient, DataOptions
from rse_pf.auth.certificates import AUTHORITY_S, CertificateWithKey, make_authority
from rse_pf.errors import ConnectError, RsePfError, UsageError
from rse_pf.wire.refusal import refusal_body
from tests.kit.fake_peers import after_request, at_once, http, peer, silent, tls_context, with_tls

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
    Case("login page", http(HTML, PORTAL), "login page", "log in"),
    Case("redirect", http("302 Found\r\nLocation: http://a.example/in?x=1"), "login page", "a.example/in "),
    Case("relative redirect", http("303 See Other\r\nLocation: /login"), "login page", "/login"),
    Case("malformed redirect", http("302 Found\r\nLocation: http://[x"), "302", "log in"),
    Case("network login", http("511 Network Authentication Required"), "login", "log in"),
    Case("nginx", NGINX_404, "'nginx/1.24.0'", "no RSE-PF server"),
    Case("TLS of nginx", http("400 Bad Request", "plain HTTP request sent to HTTPS port"), "TLS", "s://"),
    Case("TLS by redirect", http("301 x\r\nLocation: https://127.0.0.1/a"), "https://127.0.0.1/a", "scheme"),
    Case("text", http("200 OK\r\nContent-Type: text/plain", "MongoDB"), "no RSE-PF server", "host and port"),
    Case("gateway", http("502 Bad Gateway"), "reaches no server", "servers of the platform run"),
    Case("firewall", http("403 Forbidden\r\nContent-Type: text/html"), "not an RSE-PF server", "firewall"),
]  # fmt: skip
WEBSOCKET_CASES = [
    Case("http.server", http("404 File not found", version="1.0"), "'HTTP/1.0 404 File", "host and"),
    Case("starting", http("503 Service Unavailable"), "is full, or is starting", "try again later"),
    Case("no upgrade", http("426 Upgrade Required"), "removed the header Upgrade", "Upgrade and Connection"),
    Case("no upgrade at ours", http("400 Bad Request", refusal_body("bad-message", "no", "").decode()),
         "removed the header Upgrade", "Upgrade and Connection"),
    Case("JSON", http("200 OK\r\nContent-Type: application/json", "{}"), "no RSE-PF server", "host and"),
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


@pytest.mark.parametrize("case", [*HTTP_CASES, BANNERS[0], BANNERS[2]], ids=lambda case: case.name)
def test_a_data_client_names_what_answered_and_never_takes_it_for_success(case):
    serve = at_once(case.answer) if case in BANNERS else after_request(case.answer)
    with peer(serve) as port:
        shows(data_error(f"http://127.0.0.1:{port}"), case)


@pytest.mark.parametrize("answer", [NGINX_404, b"SSH-2.0-OpenSSH_9.2p1 Debian\r\n"])
async def test_a_secure_address_of_a_server_without_tls(answer):
    with peer(at_once(answer)) as port:
        for error in (
            await robot_error(f"wss://127.0.0.1:{port}/ws"),
            data_error(f"https://127.0.0.1:{port}"),
        ):
            assert "does not speak TLS" in error.message
            assert error.hint.startswith(("write ws://", "write http://"))


@pytest.fixture(scope="module")
def authority() -> CertificateWithKey:
    return make_authority("acme", now_s=time.time())


async def test_a_plain_address_of_a_server_with_tls(authority, tmp_path):
    context = tls_context(authority, ["127.0.0.1"], tmp_path, time.time())
    with peer(with_tls(context, after_request(NGINX_404))) as port:
        for error in (await robot_error(f"ws://127.0.0.1:{port}/ws"), data_error(f"http://127.0.0.1:{port}")):
            assert "write wss://" in error.hint or "write https://" in error.hint


async def test_a_certificate_of_an_unknown_authority_is_refused_with_both_remedies(authority, tmp_path):
    context = tls_context(authority, ["127.0.0.1"], tmp_path, time.time())
    with peer(with_tls(context, after_request(NGINX_404))) as port:
        for error in (
            await robot_error(f"wss://127.0.0.1:{port}/ws"),
            data_error(f"https://127.0.0.1:{port}"),
        ):
            assert "shows a certificate that this robot does not trust" in error.message
            assert "--authority" in error.hint
            assert "SSL_CERT_FILE" in error.hint


def test_an_enrolled_robot_that_does_not_trust_the_platform_has_to_be_enrolled_again(authority, tmp_path):
    context = tls_context(authority, ["127.0.0.1"], tmp_path, time.time())
    other = ssl.create_default_context(cadata=make_authority("other", now_s=time.time()).certificate)
    with peer(with_tls(context, after_request(NGINX_404))) as port, pytest.raises(ConnectError) as raised:
        DataClient(f"https://127.0.0.1:{port}", "t", replace(OPTIONS, ssl_context=other)).upload(b"x")
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
    assert "sends no answer within 1 s" in error.message
    assert "host and port" in error.hint


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
