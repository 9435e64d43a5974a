"""Strangers' bytes as maps, keyframes, sandboxes' messages, graphs and clouds: only typed errors (T26)."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fuzz.damage import run_damaged
from fuzz.meter import BARS, Meter
from fuzz.targets import TARGETS
from rse_pf import budget
from rse_pf.maps import format as map_format

pytest.importorskip("faiss", reason="needs the extra 'maps'")

_SLOW_MACHINE = 3.0
"""The bar is for a quiet core."""
_NEW = ("maps", "keyframes", "snapshots", "graph", "cloud", "live")


def fuzzed(target: str, *, inputs: int) -> Meter:
    meter, run = Meter(), TARGETS[target]
    run_damaged(target, lambda data: run(data, meter), first=11, inputs=inputs)
    return meter


@pytest.mark.parametrize(
    ("target", "inputs"),
    [("maps", 200), ("snapshots", 200), ("keyframes", 10), ("graph", 15), ("cloud", 15), ("live", 60)],
)
def test_damaged_bytes_give_an_answer_or_a_typed_error(target: str, inputs: int) -> None:
    meter = fuzzed(target, inputs=inputs)

    assert meter.calls >= inputs
    if target in BARS:
        max_ms, max_mib = BARS[target]
        assert sum(meter.refusals.values()) > inputs // 4, "the damage did no damage"
        assert meter.worst_ms < _SLOW_MACHINE * max_ms, meter.line()
        assert meter.worst_mib < max_mib, meter.line()


def test_a_worker_that_does_not_count_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    lists = b"\x00\xdd\x00\x00\x50\x00" + b"\x90" * 0x5000

    assert refusals("snapshots", lists) == {"too-large": 1}
    monkeypatch.setattr(budget, "check_msgpack", lambda data, budget: True)
    assert refusals("snapshots", lists) == {}


def test_a_map_decoder_that_does_not_count_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    keys = b"".join(b"\xa5%05x\x90" % number for number in range(45_000))
    fields = b"\xa9keyframes\x90\xa5edges\x90\xa6points\xc4\x00\xa7colours\xc4\x00\xaaprovenance"
    wide = b"\x00\x85" + fields + b"\xdf\x00\x00\xaf\xc8" + keys
    deep = b"\x00\x85" + fields + b"\x81\xa1a" + b"\x91" * 500 + b"\x01"

    assert refusals("maps", wide, deep) == {"too-large": 2}
    monkeypatch.setattr(map_format, "_check_sections", lambda text, limits: None)
    assert refusals("maps", wide, deep) == {}


def refusals(target: str, *inputs: bytes) -> dict[str, int]:
    meter = Meter()
    for data in inputs:
        TARGETS[target](data, meter)
    return meter.refusals


@pytest.mark.slow
@pytest.mark.timeout(180)
@pytest.mark.parametrize("target", _NEW)
def test_a_minute_of_fuzzing_finds_nothing(target: str, repository: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "fuzz", target, "--seconds", "60", "--found", str(tmp_path)]

    done = subprocess.run(
        command, cwd=repository, capture_output=True, text=True, check=False, env=os.environ
    )

    print(done.stdout[-1500:])
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-1500:]
    assert "above the limits" not in done.stdout or os.getloadavg()[0] > 2.0, done.stdout
