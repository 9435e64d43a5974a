"""Matches of ORB descriptors are those of the definition, with any instructions of the processor."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from rse_pf.slam.descriptors import match_all, match_orb
from tests.oracles import matching

LANES = pytest.mark.parametrize("lanes", ["portable", "avx2", "avx512"])
Bits = npt.NDArray[np.uint8]


def descriptors(rng: np.random.Generator, n: int, *, distinct: int, noise: int) -> Bits:
    """Return descriptors of which many are equal, or at equal distances."""
    bits = np.random.default_rng(3).integers(0, 256, (distinct, 32), dtype=np.uint8)
    bits = bits[rng.integers(0, distinct, n)]
    for _ in range(noise):
        bits[np.arange(n), rng.integers(0, 32, n)] ^= np.uint8(1) << rng.integers(0, 8, n).astype(np.uint8)
    return bits


@LANES
def test_matches_are_those_of_the_definition_among_many_ties(lanes: Any) -> None:
    counts = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        n, m = rng.integers(1, 90, 2) if seed % 3 else rng.integers(200, 900, 2)
        kind = {"distinct": int(rng.choice([1, 3, 20, 700])), "noise": int(rng.choice([0, 2, 12]))}
        first, second = descriptors(rng, n, **kind), descriptors(rng, m, **kind)
        ratio = float(rng.choice([0.5, 0.75, 0.8, 1.0]))

        rows, columns = match_orb(first, second, ratio, lanes=lanes)

        expected = matching.best_matches(first, second, ratio)
        assert (rows.tolist(), columns.tolist()) == (expected[0].tolist(), expected[1].tolist()), seed
        counts.append(len(rows))
    assert min(counts) == 0
    assert max(counts) > 100


def test_matches_beyond_the_largest_distance_are_left_out() -> None:
    rng = np.random.default_rng(4)
    first = rng.integers(0, 256, (300, 32), dtype=np.uint8)
    second = first[rng.permutation(300)] ^ (rng.random((300, 32)) < 0.2).astype(np.uint8)
    second[:40] = second[40:80]  # equal ones are no clear match

    rows, columns = match_all(first, second, max_distance=6)

    distances = np.diag(matching.hamming(first, second)[rows][:, columns])
    every = match_all(first, second, max_distance=256)
    assert 50 < len(rows) < len(every[0]) < 300
    assert distances.max() == 6
    assert rows.tolist() == sorted(rows)
