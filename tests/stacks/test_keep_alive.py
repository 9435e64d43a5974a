"""The data service keeps idle connections for longer than the load balancer, which would else get a 502."""

from __future__ import annotations

import select
import socket
from pathlib import Path
from typing import Any

import pytest

from tests.kit.data_process import DataProcess

Assembly = Any

MARGIN_S = 2.0
REQUEST = b"GET /data/healthz HTTP/1.1\r\nHost: here\r\n\r\n"


def idle_timeout_s(assembly: Assembly) -> float:
    """Return how long the load balancer of the template keeps an idle connection to a server."""
    balancer = assembly.one("AWS::ElasticLoadBalancingV2::LoadBalancer")
    chosen = {each["Key"]: each["Value"] for each in balancer["LoadBalancerAttributes"]}
    return float(chosen["idle_timeout.timeout_seconds"])


def answer(connection: socket.socket) -> bytes:
    """Ask, and return the whole answer, whose body is JSON."""
    connection.sendall(REQUEST)
    received = b""
    while not received.endswith(b"}"):
        piece = connection.recv(4096)
        assert piece, received
        received += piece
    return received


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.timeout(240)
def test_a_connection_that_the_load_balancer_uses_again_is_still_open(
    assembly: Assembly, tmp_path: Path
) -> None:
    if assembly.settings.cloud.allow_insecure:
        pytest.skip("both templates have the same load balancer")
    with (
        DataProcess(tmp_path) as service,
        socket.create_connection(("127.0.0.1", service.port), 10) as connection,
    ):
        assert answer(connection).startswith(b"HTTP/1.1 200")

        closed, _, _ = select.select([connection], [], [], idle_timeout_s(assembly) + MARGIN_S)

        assert not closed, "the service closed first"
        assert answer(connection).startswith(b"HTTP/1.1 200")
