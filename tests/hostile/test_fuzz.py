"""Strangers' bytes against every decoder: typed errors, in bounded time and memory (T7, T8, T13, T26)."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fuzz.damage import run_damaged
from fuzz.meter import BARS, MAX_MIB, MAX_MS, Meter
from fuzz.targets import TARGETS

_SLOW_MACHINE = 3.0
"""The bar is for a quiet core; what is held on a crowded one still tells a tenth of a second from it."""


def fuzzed(target: str, *, seed: int, inputs: int) -> Meter:
    meter, run = Meter(), TARGETS[target]
    run_damaged(target, lambda data: run(data, meter), first=seed, inputs=inputs)
    return meter


def test_thousands_of_damaged_messages_give_a_message_or_a_protocol_error() -> None:
    meter = fuzzed("codec", seed=7, inputs=1500)

    assert meter.refusals.keys() <= {"bad-message", "too-large"}
    assert meter.refusals["bad-message"] > 500, "the damage did no damage"
    assert meter.worst_ms < _SLOW_MACHINE * MAX_MS, meter.line()
    assert meter.worst_mib < MAX_MIB, meter.line()


@pytest.mark.parametrize(
    ("target", "inputs"),
    [("frames", 1500), ("stream", 80), pytest.param("frames", 20_000, marks=pytest.mark.slow)],
)
def test_thousands_of_damaged_streams_keep_the_rules(target: str, inputs: int) -> None:
    assert fuzzed(target, seed=5, inputs=inputs).worst_mib < 1.0


@pytest.mark.parametrize(
    ("target", "inputs"),
    [("maps", 200), ("snapshots", 200), ("keyframes", 10), ("graph", 15), ("cloud", 15), ("live", 60)],
)
def test_damaged_bytes_give_an_answer_or_a_typed_error(target: str, inputs: int) -> None:
    meter = fuzzed(target, seed=11, inputs=inputs)

    assert meter.calls >= inputs
    if target in BARS:
        max_ms, max_mib = BARS[target]
        assert sum(meter.refusals.values()) > inputs // 4, "the damage did no damage"
        assert meter.worst_ms < _SLOW_MACHINE * max_ms, meter.line()
        assert meter.worst_mib < max_mib, meter.line()


@pytest.mark.slow
@pytest.mark.timeout(180)
@pytest.mark.parametrize(
    "target", ["codec", "frames", "stream", "maps", "keyframes", "snapshots", "graph", "cloud", "live"]
)
def test_a_minute_of_fuzzing_finds_nothing(target: str, repository: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "fuzz", target, "--found", str(tmp_path)]
    if target in ("codec", "frames", "stream"):
        pytest.importorskip("atheris", reason="atheris has no wheel for this Python")
        command += ["--engine", "atheris"]
    else:
        command += ["--seconds", "60"]

    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, check=False)

    print(done.stdout[-1500:], done.stderr[-1500:])
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-3000:]
    assert "above the limits" not in done.stdout or os.getloadavg()[0] > 2.0, done.stdout
