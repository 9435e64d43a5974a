"""Matches of ORB descriptors are those of the definition, with any instructions of the processor."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from rse_pf.slam.descriptors import best_matches, match_all, match_orb
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


@LANES
@pytest.mark.parametrize(
    ("fills", "nearest"), [((0, 255), [0]), ((255, 0), [1]), ((255, 255), []), ((0, 0), [])]
)
def test_all_bits_and_no_bit_may_differ(lanes: Any, fills: tuple[int, int], nearest: list[int]) -> None:
    view = np.repeat(np.uint8(fills)[:, None], 32, axis=1)

    _, columns = match_orb(np.zeros((1, 32), np.uint8), view, 1.0, lanes=lanes)

    assert columns.tolist() == nearest  # two at one distance are no clear match


def test_arrays_need_not_be_contiguous() -> None:
    rng = np.random.default_rng(0)
    first, second = (descriptors(rng, n, distinct=200, noise=2) for n in (80, 90))

    found = best_matches(np.repeat(first, 2, axis=0)[::2], np.asfortranarray(second), 0.8)

    assert len(found[0]) > 10
    np.testing.assert_array_equal(found, best_matches(first, second, 0.8))


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
