"""A hostile tenant does not slow, stop or fill what another tenant uses; the short form of the benchmark."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from benchmarks.hostile.one_tenant import GROWTH_MIB, QUOTA_BYTES, measure

pytestmark = [pytest.mark.slow, pytest.mark.system, pytest.mark.timeout(240)]
PAIRS, SECONDS = 3, 15.0


@pytest.mark.parametrize("attack", ["leave", "topics"])  # 110 s each; the benchmark runs all of them
def test_nothing_of_another_tenant_is_refused_and_no_store_is_filled(attack: str, tmp_path: Path) -> None:
    """Ratios of p99 need a machine that does nothing else: the benchmark prints them."""
    (row,) = asyncio.run(measure([attack], PAIRS, SECONDS, tmp_path))

    assert row["refused"] == {}
    assert row["n"]["pose"] > 0.5 * 10.0 * 2 * PAIRS * SECONDS
    assert row["stored_mib"] <= QUOTA_BYTES / 2**20 + GROWTH_MIB
