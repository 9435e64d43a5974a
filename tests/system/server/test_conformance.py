"""The Autobahn cases against the product's own frame layer, over its conformance echo."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.local.balancer.envoy_config import Target
from rse_pf.local.balancer.load_balancer import EnvoyLoadBalancer

pytestmark = [pytest.mark.system, pytest.mark.slow]

SMALL_FRAGMENTS = {f"9.{group}.{case}" for group in (3, 4) for case in range(1, 6)}
"""4 MB in fragments of 64 B to 16 KiB: more than the product's limit of 64 fragments."""

BIG = {"max_message_bytes": 17_000_000, "max_inflated_bytes": 17_000_000}


def run_suite(port: int, folder: Path, *selection: str, path: str = "/") -> tuple[int, set[str], str]:
    """Return how many cases passed, which failed, and what the suite printed."""
    if importlib.util.find_spec("kosoku") is None:
        pytest.skip("kosoku is not installed (no wheel for this machine)")
    suite = subprocess.run(
        [Path(sys.executable).with_name("kosoku"), "-p", "2", "-o", folder, *selection,
         f"ws://127.0.0.1:{port}{path}"],
        capture_output=True, text=True, timeout=110, check=False,
    )  # fmt: skip
    (index,) = json.loads((folder / "index.json").read_text()).values()
    passed = {
        case for case, told in index.items() if told["behavior"] in PASSED and told["behaviorClose"] in PASSED
    }
    return len(passed), set(index) - passed, suite.stdout + suite.stderr


PASSED = {"OK", "NON-STRICT", "INFORMATIONAL"}


def test_all_247_cases_pass_with_the_products_limits(start_server, tmp_path):
    server = start_server(echo=True, serving={"workers": 2})

    passed, failed, printed = run_suite(server.port, tmp_path / "r", "-x", "9.*", "-x", "12.*", "-x", "13.*")

    assert failed == set(), printed
    assert passed == 247


def test_all_54_large_cases_pass_with_raised_limits(start_server, tmp_path):
    limits = {**BIG, "max_fragments": 100_000}
    server = start_server(echo=True, serving={"slow_reader_timeout_s": 30.0}, session=limits)

    passed, failed, printed = run_suite(server.port, tmp_path / "r", "-i", "9.*")

    assert failed == set(), printed
    assert passed == 54


def test_the_fragment_limit_refuses_exactly_the_ten_cases_above_it(start_server, tmp_path):
    server = start_server(echo=True, serving={"slow_reader_timeout_s": 30.0}, session=BIG)

    _, failed, printed = run_suite(server.port, tmp_path / "r", "-i", "9.*")

    assert failed == SMALL_FRAGMENTS, printed


def test_through_the_load_balancer_only_the_order_of_closing_differs(start_server, tmp_path):
    server = start_server(echo=True, serving={"workers": 2})
    settings = PlatformSettings()
    balancer = EnvoyLoadBalancer(settings, folder=tmp_path, port=0, dies_with_parent=True)
    target = Target(name="echo", port=server.port, control_port=server.identity["control_port"])

    async def start() -> None:
        balancer.launch()
        await balancer.wait_live(20)
        balancer.set_targets([target])
        assert await balancer.wait_healthy(["echo"], 10)

    try:
        asyncio.run(start())
        path = "/ws"
        select = ("-x", "9.*", "-x", "12.*", "-x", "13.*")
        passed, failed, printed = run_suite(balancer.port, tmp_path / "r", *select, path=path)
    finally:
        balancer.kill()
    (index,) = json.loads((tmp_path / "r" / "index.json").read_text()).values()

    assert len(index) == 247
    assert {case for case, told in index.items() if told["behavior"] not in PASSED} == set(), printed
    print(f"through the load balancer {passed} of 247 pass; {len(failed)} differ in who closes first")
