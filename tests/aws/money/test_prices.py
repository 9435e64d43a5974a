"""Prices come from a dated file, and a file of the operator replaces some or all of them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rse_pf.aws.money.prices import load_prices
from rse_pf.errors import ConfigurationError


def test_our_prices_say_when_and_where_they_held_and_who_read_them() -> None:
    prices = load_prices()

    assert all((prices.as_of, prices.region, prices.currency, prices.source, prices.instance_type))


def test_a_file_replaces_only_what_it_names(tmp_path: Path) -> None:
    file = tmp_path / "prices.json"
    file.write_text(json.dumps({"region": "eu-central-1", "server_per_hour": 1}), encoding="utf-8")

    prices, ours = load_prices(file), load_prices()

    assert (prices.region, prices.server_per_hour) == ("eu-central-1", 1.0)
    assert prices.endpoint_per_hour == ours.endpoint_per_hour


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "holds no prices"),
        (b"[1]", "holds no prices"),
        (b"[" * 100_000, "holds no prices"),
        (b'{"server_per_day": 1}', "server_per_day"),
        (b'{"server_per_hour": "1"}', "server_per_hour"),
        (b'{"server_per_hour": -1}', "server_per_hour"),
        (b'{"server_vcpus": 0}', "server_vcpus"),
        (b'{"command_cpu_ms": 0}', "command_cpu_ms"),
    ],
)
def test_a_bad_file_is_one_line_and_a_hint(tmp_path: Path, data: bytes, problem: str) -> None:
    file = tmp_path / "prices.json"
    file.write_bytes(data)

    with pytest.raises(ConfigurationError, match=problem) as caught:
        load_prices(file)

    assert "\n" not in caught.value.message
    assert "server_per_hour" in caught.value.hint


def test_a_file_that_is_missing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="cannot read"):
        load_prices(tmp_path / "nothing.json")
