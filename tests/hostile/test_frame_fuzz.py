"""Any frames at all: messages of allowed size, pongs at an allowed rate, or one close (T13)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fuzz.damage import run_damaged
from fuzz.meter import Meter
from fuzz.targets import TARGETS, TargetFailure
from rse_pf.backend.gateway import frames as frame_layer
from rse_pf.backend.gateway.frames import CloseBorder, FrameAssembler
from rse_pf.token_bucket import TokenBucket


def fuzzed(target: str, *, seed: int, inputs: int) -> Meter:
    meter, run = Meter(), TARGETS[target]
    run_damaged(target, lambda data: run(data, meter), first=seed, inputs=inputs)
    return meter


@pytest.mark.parametrize(
    ("target", "inputs"),
    [("frames", 1500), ("stream", 80), pytest.param("frames", 20_000, marks=pytest.mark.slow)],
)
def test_thousands_of_damaged_streams_keep_the_rules(target: str, inputs: int) -> None:
    assert fuzzed(target, seed=5, inputs=inputs).worst_mib < 1.0


@given(data=st.binary(max_size=600))
@settings(max_examples=150)
def test_random_frames_keep_the_rules(data: bytes) -> None:
    for target in ("frames", "stream"):
        TARGETS[target](data, Meter())


def _endless(self: FrameAssembler, fin: bool, payload: bytes) -> Any:
    if self._message is None:
        return self._close(1002, "nothing to continue")
    self._message.append(payload)
    if not fin:
        return None
    whole, self._message = b"".join(self._message), None
    return self._finish(self._opcode, whole)


_read_head = CloseBorder._read_head


def _forgetful(self: CloseBorder, data: memoryview, i: int) -> int:
    self._head = b""
    return _read_head(self, data, i)


WRONG: dict[str, tuple[str, type[Any], str, Callable[..., Any]]] = {
    "fragments are not counted": ("frames", FrameAssembler, "_continue", _endless),
    "control frames have no rate": ("frames", TokenBucket, "take", lambda self, now: 0.0),
    "a close is forgotten": (
        "frames", FrameAssembler, "_close",
        lambda self, code, reason: frame_layer.CloseSocket(code, reason),
    ),
    "a head that is cut is read as if it were whole": (
        "stream", CloseBorder, "_read_head", _forgetful,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_a_defect_in_the_frame_layer_is_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    target, kind, method, wrong = WRONG[name]
    monkeypatch.setattr(kind, method, wrong)

    with pytest.raises(TargetFailure):
        fuzzed(target, seed=5, inputs=1000)
