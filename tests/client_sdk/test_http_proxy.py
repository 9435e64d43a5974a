"""Robot and data client use the proxy of the environment, and explain its refusals without its password."""

from __future__ import annotations

import base64
import hashlib

import msgspec
import pytest

import client_sdk
from client_sdk.network.connect_timings import ConnectTimings
from client_sdk.network.http_proxy import find_proxy
from client_sdk.transfer.data_client import DataClient, DataOptions
from rse_pf.errors import RsePfError, UsageError
from tests.kit.fake_peers import after_request, http, peer, proxy_to, silent
from tests.kit.fake_platform import FakePlatform

VARIABLES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "NO_PROXY")
TIMINGS = ConnectTimings(connect_timeout_s=1.0, reconnect_max_s=0.01)
OPTIONS = DataOptions(timeout_s=1.0, deadline_s=0.5, first_pause_s=0.01)
CREDENTIALS = "robot:s%40cret@"
URL = "http://" + CREDENTIALS + "proxy.example:3128"


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
        monkeypatch.delenv(name.lower(), raising=False)
    return monkeypatch.setenv


@pytest.mark.parametrize(
    ("scheme", "given", "variable"),
    [
        ("ws", {"HTTP_PROXY": URL}, "HTTP_PROXY"),
        ("ws", {"http_proxy": URL}, "HTTP_PROXY"),
        ("http", {"HTTP_PROXY": URL}, "HTTP_PROXY"),
        ("wss", {"HTTPS_PROXY": URL, "ALL_PROXY": "http://other"}, "HTTPS_PROXY"),
        ("https", {"https_proxy": URL}, "HTTPS_PROXY"),
        ("wss", {"ALL_PROXY": URL, "HTTP_PROXY": "http://other"}, "ALL_PROXY"),
        ("ws", {"all_proxy": URL.removeprefix("http://")}, "ALL_PROXY"),
    ],
)
def test_the_variable_of_the_scheme_names_the_proxy(scheme, given, variable, environment):
    for name, value in given.items():
        environment(name, value)

    proxy = find_proxy(scheme, "robots.example", 443)

    assert proxy is not None
    assert (proxy.variable, proxy.host, proxy.port) == (variable, "proxy.example", 3128)
    assert base64.b64decode(proxy.authorization.removeprefix("Basic ")) == b"robot:s@cret"
    assert "cret" not in repr(proxy) + proxy.shown_url


@pytest.mark.parametrize(
    ("exempt", "host", "is_direct"),
    [
        ("", "localhost", True),
        ("", "127.0.0.2", True),
        ("", "::1", True),
        ("", "robots.example", False),
        ("*", "robots.example", True),
        ("robots.example", "robots.example", True),
        ("a.b, .example", "robots.example", True),
        ("example", "robots.example", True),
        ("ots.example", "robots.example", False),
        ("ROBOTS.example:8700", "robots.example", True),
        ("robots.example:80", "robots.example", False),
        ("10.0.0.0/8", "10.1.2.3", True),
        ("192.168.0.0/16,10.1.2.3", "10.1.2.3", True),
        ("10.1.2.3:8700", "10.1.2.3", True),
        ("10.2.0.0/16", "10.1.2.3", False),
        ("fd00::/8", "fd00::7", True),
        ("fd00::7", "fd00::7", True),
        ("nonsense/99,10.0.0.0/8", "robots.example", False),
    ],
)
def test_no_proxy_exempts_hosts_suffixes_ports_and_networks(exempt, host, is_direct, environment):
    environment("HTTP_PROXY", URL)
    environment("no_proxy", exempt)

    assert (find_proxy("ws", host, 8700) is None) is is_direct


@pytest.mark.parametrize(
    "value", ["socks5h://h:1080", "https://h:443", "http://", "http://a:b@c:d", "http://[::1"]
)
async def test_a_variable_without_an_http_proxy_is_named_and_its_value_is_not_shown(value, environment):
    environment("ALL_PROXY", value)

    for error in (await robot_error(), data_error()):
        assert isinstance(error, UsageError)
        assert error.message == "ALL_PROXY names no HTTP proxy"
        assert "NO_PROXY" in error.hint


@pytest.mark.system
async def test_a_robot_behind_a_proxy_reaches_a_host_that_only_the_proxy_knows(environment):
    asked: list[str] = []
    async with FakePlatform() as platform:
        with peer(proxy_to(platform.port, asked)) as port:
            environment("HTTP_PROXY", f"http://robot:secret@127.0.0.1:{port}")
            async with client_sdk.connect("ws://robots.invalid/ws") as robot:
                assert (await robot.call("echo", {"value": 7})).reply["value"] == 7

    assert asked[0].startswith("CONNECT robots.invalid:80 ")
    assert base64.b64encode(b"robot:secret").decode() in asked[0]


def test_data_goes_through_the_proxy_too(environment):
    asked: list[str] = []
    stored = msgspec.json.encode({"digest": hashlib.sha256(b"").hexdigest(), "size": 0}).decode()
    answer = http("201 Created\r\nContent-Type: application/json", stored)
    with peer(after_request(answer)) as service, peer(proxy_to(service, asked)) as port:
        environment("all_proxy", f"http://127.0.0.1:{port}")
        DataClient("http://robots.invalid:8700", "t", OPTIONS).upload(b"")

    assert asked[0].startswith("CONNECT robots.invalid:8700 ")


@pytest.mark.parametrize(
    ("answer", "credentials", "message", "hint"),
    [
        (http("407 Proxy Authentication Required"), "", "answers 407", "set HTTP_PROXY=http://USER:"),
        (http("407 x", version="1.0"), "robot:secret@", "answers 407", "set HTTP_PROXY=http://USER:"),
        (http("403 Forbidden"), "", "answers 403 Forbidden", "allow CONNECT"),
        (http("502 Bad Gateway"), "robot:secret@", "answers 502", "check host and port of the URL"),
        (http("511 Network Authentication Required"), "", "answers 511", "check host and port"),
        (http("302 Found\r\nLocation: http://a.example"), "", "answers 302", "allow CONNECT"),
        (http("405 Method Not Allowed"), "", "answers 405", "allow CONNECT"),
        (b"SSH-2.0-OpenSSH_9.2p1\r\n", "robot:secret@", "does not answer as a proxy", "correct HTTP_PROXY"),
    ],
)  # fmt: skip
async def test_a_refusal_of_the_proxy_is_one_line(answer, credentials, message, hint, environment):
    with peer(after_request(answer)) as port:
        environment("HTTP_PROXY", f"http://{credentials}127.0.0.1:{port}")
        for error in (await robot_error(), data_error()):
            assert f"http://127.0.0.1:{port}, which HTTP_PROXY names," in error.message
            assert message in error.message
            assert hint in error.hint
            assert "secret" not in error.message + error.hint


@pytest.mark.parametrize("proxy", ["127.0.0.1:9", "proxy.invalid:3128", "silent"])
async def test_a_proxy_that_cannot_be_reached_is_named(proxy, environment):
    with peer(silent) as port:
        environment("HTTP_PROXY", "http://" + proxy.replace("silent", f"127.0.0.1:{port}"))
        for error in (await robot_error(), data_error()):
            assert "which HTTP_PROXY names, does not answer as a proxy" in error.message
            assert "robots.invalid in NO_PROXY" in error.hint


async def robot_error() -> RsePfError:
    with pytest.raises(RsePfError) as raised:
        async with client_sdk.connect("ws://robots.invalid/ws", token="t", timings=TIMINGS):
            pass
    return raised.value


def data_error() -> RsePfError:
    with pytest.raises(RsePfError) as raised:
        DataClient("http://robots.invalid", "t", OPTIONS).upload(b"x")
    return raised.value
