"""Prices come from a dated file, and a file of the operator replaces some or all of them."""

from __future__ import annotations

from datetime import date
from pathlib import Path

import pytest

from rse_pf.errors import ConfigurationError
from rse_pf.extensions.costs.prices import load_prices, operators_prices


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "holds no prices"),
        (b"[1]", "holds no prices"),
        (b"[" * 100_000, "holds no prices"),
        (b'{"endpoint_per_day": 1}', "endpoint_per_day"),
        (b'{"endpoint_per_hour": "1"}', "endpoint_per_hour"),
        (b'{"endpoint_per_hour": -1}', "endpoint_per_hour"),
        (b'{"servers": {"a.large": {"vcpus": 0, "per_hour": 1, "spot_per_hour": 1}}}', "vcpus"),
        (b'{"servers": 1}', "servers"),
        (b'{"as_of": "2025-02-31"}', "day"),
        (b'{"as_of": "lately"}', "as_of"),
        (b'{"command_cpu_ms": 0}', "command_cpu_ms"),
    ],
)
def test_a_bad_file_is_one_line_and_a_hint(tmp_path: Path, data: bytes, problem: str) -> None:
    file = tmp_path / "prices.json"
    file.write_bytes(data)

    with pytest.raises(ConfigurationError, match=problem) as caught:
        load_prices(file)

    assert "\n" not in caught.value.message
    assert "endpoint_per_hour" in caught.value.hint


def test_prices_that_are_old_or_of_another_region_are_reported_with_what_to_do() -> None:
    ours = load_prices()
    day = date.fromisoformat(ours.as_of)

    stale = ours.warnings(today=date(day.year + 2, 1, 1), region=ours.region)
    elsewhere = ours.warnings(today=day, region="eu-central-1")

    assert ours.warnings(today=day, region=ours.region) == []
    for lines, problem in ((stale, "STALE"), (elsewhere, "WRONG REGION")):
        assert lines[0].startswith(problem)
        assert "prices.json" in lines[1]


def test_the_operators_file_beside_the_settings_is_used_before_ours(tmp_path: Path) -> None:
    assert operators_prices(None, tmp_path) == load_prices()
    (tmp_path / "prices.json").write_text('{"endpoint_per_hour": 9}', encoding="utf-8")

    assert operators_prices(None, tmp_path).endpoint_per_hour == 9
