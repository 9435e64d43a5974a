"""The data service keeps idle connections for longer than the load balancer, which would else get a 502."""

from __future__ import annotations

import contextlib
import json
import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rse_pf.auth.tokens import SigningKey

Assembly = Any

START_S, MARGIN_S = 30.0, 2.0
REQUEST = b"GET /data/healthz HTTP/1.1\r\nHost: here\r\n\r\n"


def idle_timeout_s(assembly: Assembly) -> float:
    """Return how long the load balancer of the template keeps an idle connection to a server."""
    balancer = assembly.one("AWS::ElasticLoadBalancingV2::LoadBalancer")
    chosen = {each["Key"]: each["Value"] for each in balancer["LoadBalancerAttributes"]}
    return float(chosen["idle_timeout.timeout_seconds"])


@contextlib.contextmanager
def data_service(folder: Path) -> Iterator[int]:
    """Run rse-pf data; yield its port."""
    keys, told = folder / "keys.json", folder / "data.json"
    keys.write_text(SigningKey.from_seed(b"k" * 32, "key-1").key_set().to_json())
    process = subprocess.Popen(
        [sys.executable, "-m", "rse_pf.cli.main", "data", "--keys", str(keys), "--store", "memory:",
         "--port", "0", "--announce", str(told)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        until_s = time.monotonic() + START_S
        while not told.exists():
            assert process.poll() is None
            assert time.monotonic() < until_s
            time.sleep(0.02)
        yield int(json.loads(told.read_text())["port"])
    finally:
        process.terminate()
        process.wait(START_S)


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.timeout(240)
def test_a_connection_that_the_load_balancer_uses_again_is_still_open(
    assembly: Assembly, tmp_path: Path
) -> None:
    if assembly.settings.cloud.allow_insecure:
        pytest.skip("both templates have the same load balancer")
    with data_service(tmp_path) as port, socket.create_connection(("127.0.0.1", port), 10) as connection:
        connection.sendall(REQUEST)
        assert connection.recv(4096).startswith(b"HTTP/1.1 200")

        closed, _, _ = select.select([connection], [], [], idle_timeout_s(assembly) + MARGIN_S)

        assert not closed, "the service closed first"
        connection.sendall(REQUEST)
        assert connection.recv(4096).startswith(b"HTTP/1.1 200")
