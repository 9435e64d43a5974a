"""Hostile maps against the decoder: refused or contained, in bounded time and memory (T26)."""

from __future__ import annotations

import gc
import time
import tracemalloc

import pytest

from rse_pf.errors import BadRequest, RsePfError
from rse_pf.maps.format import MapVersion, decode_map
from tests.kit.hostile_maps import DAMAGED_PROVENANCE, DECODABLE, hostile_maps

_MAX_MS, _MAX_MIB = 100.0, 64.0
_SLOW_MACHINE = 6.0
"""The bar is for a quiet core."""
_TRACED_FROM_MS = 1.0
"""Nothing takes 64 MiB in less."""


def outcome_of(data: bytes) -> MapVersion | RsePfError:
    try:
        return decode_map(data)
    except RsePfError as error:
        return error


def peak_mib(data: bytes) -> float:
    tracemalloc.start()
    try:
        outcome_of(data)
        return tracemalloc.get_traced_memory()[1] / 2**20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", hostile_maps())
def test_every_hostile_map_is_refused_or_contained(name: str) -> None:
    data = hostile_maps()[name]

    gc.disable()  # a collection takes as long as all other tests of this process left objects
    try:
        begin = time.thread_time()
        outcome = outcome_of(data)
        took_ms = (time.thread_time() - begin) * 1e3
    finally:
        gc.enable()

    assert isinstance(outcome, MapVersion) == (name in DECODABLE), outcome
    if isinstance(outcome, RsePfError):
        assert outcome.code in ("bad-request", "too-large", "invalid-camera"), outcome.code
        assert outcome.hint
        assert len(outcome.message) < 400
    assert took_ms < _SLOW_MACHINE * _MAX_MS
    assert took_ms < _TRACED_FROM_MS or peak_mib(data) < _MAX_MIB


@pytest.mark.parametrize("name", sorted(DAMAGED_PROVENANCE))
def test_a_damaged_provenance_is_refused_when_it_is_asked_for(name: str) -> None:
    version = decode_map(hostile_maps()[name])

    for _ in range(2):
        with pytest.raises(BadRequest, match="provenance"):
            dict(version.provenance)
