"""Strangers' bytes against the codecs: only our own errors leave, in bounded time and memory (T7, T8)."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from fuzz.__main__ import main
from fuzz.damage import run_damaged
from fuzz.meter import MAX_MIB, MAX_MS, Meter
from fuzz.samples import CORPUS, MAX_INPUT_BYTES
from fuzz.targets import TARGETS
from rse_pf.wire import codec, native_codec

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


def test_equal_seeds_give_equal_inputs_and_others_do_not() -> None:
    def inputs(seed: int) -> list[bytes]:
        seen: list[bytes] = []
        run_damaged("codec", seen.append, first=seed, inputs=200)
        return seen

    first = inputs(1)
    assert inputs(1) == first
    assert inputs(2) != first
    assert all(len(data) <= MAX_INPUT_BYTES for data in first)


def test_a_decoder_that_lets_a_foreign_error_out_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(codec, "_decode_guarded", lambda decode, data: decode(data))

    with pytest.raises(msgspec.DecodeError):
        fuzzed("codec", seed=7, inputs=1500)


def test_every_target_keeps_a_corpus() -> None:
    assert {target: bool(list((CORPUS / target).glob("*"))) for target in TARGETS} == dict.fromkeys(
        TARGETS, True
    )


@pytest.mark.parametrize("engine", ["hypothesis", "atheris"])
def test_without_a_native_core_its_targets_say_that_they_compare_nothing(
    engine: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    if engine == "atheris":
        atheris = pytest.importorskip("atheris", reason="atheris has no wheel for this Python")
        monkeypatch.setattr(atheris, "Fuzz", lambda: sys.exit("it fuzzed"))
    monkeypatch.setattr(native_codec, "native_codec", lambda: None)

    with contextlib.suppress(SystemExit):
        main(["answer", "--engine", engine, "--seconds", "0"])

    assert capsys.readouterr().out == "answer: skipped: the native core is not built, or cannot be loaded\n"


@pytest.mark.slow
@pytest.mark.timeout(180)
@pytest.mark.parametrize("target", ["codec", "frames", "stream"])
def test_a_minute_of_fuzzing_finds_nothing(target: str, repository: Path, tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="atheris has no wheel for this Python")
    command = [sys.executable, "-m", "fuzz", target, "--engine", "atheris", "--found", str(tmp_path)]

    done = subprocess.run(command, cwd=repository, capture_output=True, text=True, check=False)

    print(done.stderr[-1500:])
    assert done.returncode == 0, done.stderr[-3000:]
