"""Hostile maps against the decoder: refused or contained, in bounded time and memory (T26)."""

from __future__ import annotations

import gc
import time
import tracemalloc

import pytest
from hostile.hostile_maps import DAMAGED_PROVENANCE, DECODABLE, hostile_maps

from rse_pf.errors import BadRequest, RsePfError
from rse_pf.maps import format as map_format
from rse_pf.maps.format import MapVersion, decode_map

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


def test_there_are_many_hostile_maps_and_all_are_small() -> None:
    maps = hostile_maps()

    assert len(maps) >= 40
    assert len(set(maps.values())) == len(maps)
    assert max(map(len, maps.values())) <= 512 * 1024
    assert maps.keys() >= DECODABLE


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


def test_a_decoder_without_the_ratio_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(map_format, "_FREE_BYTES", 1 << 30)

    assert peak_mib(hostile_maps()["a text of 64 MiB"]) > _MAX_MIB


def test_a_decoder_that_reads_no_provenance_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    generous = map_format.Budget(
        wire_bytes=1 << 30, inflated_bytes=1 << 30, inflate_ratio=1e9, free_bytes=1 << 30, depth=10**9,
        containers=10**9, values=10**9, mixed_values=10**9, memory_bytes=1 << 30,
    )  # fmt: skip
    monkeypatch.setattr(map_format, "PROVENANCE", generous)

    assert isinstance(outcome_of(hostile_maps()["keys"]), MapVersion)
