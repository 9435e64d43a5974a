"""Which frames are played at a rate: jitter, gaps, the own rate, and lower ones."""

from __future__ import annotations

import numpy as np
import pytest

from client_sdk.datasets.thinning import Thinning, median_interval_s
from rse_pf.errors import UsageError

RATE_HZ = 30.0


def jittered(seed: int, *, frames: int = 900, jitter: float = 0.2) -> tuple[float, ...]:
    """Return stamps at 30 Hz, each up to *jitter* intervals early or late."""
    noise = np.random.default_rng(seed).uniform(-jitter, jitter, frames)
    return tuple((1.7e9 + (np.arange(frames) + noise) / RATE_HZ).tolist())


def played(stamps: tuple[float, ...], rate_hz: float, *, is_known: bool = True) -> list[float]:
    thinning = Thinning(rate_hz, interval_s=median_interval_s(stamps) if is_known else None)
    return [stamp_s for stamp_s in stamps if thinning.selects(stamp_s)]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("rate_hz", [29.97, 30.0, 30.5, 60.0, 1e9])
def test_the_own_rate_and_higher_ones_play_every_frame(seed: int, rate_hz: float) -> None:
    stamps = jittered(seed, jitter=0.45)

    assert played(stamps, rate_hz) == list(stamps)


@pytest.mark.parametrize("is_known", [True, False])
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("rate_hz", [20.0, 15.0, 12.5, 10.0, 7.0, 5.0, 0.5])
def test_a_lower_rate_is_met_on_average_and_no_two_frames_are_close(
    rate_hz: float, seed: int, is_known: bool
) -> None:
    stamps = jittered(seed)

    chosen = played(stamps, rate_hz, is_known=is_known)

    # At 20 Hz the only frame of a due time is sometimes too close to the one before.
    assert len(chosen) == pytest.approx(rate_hz * len(stamps) / RATE_HZ, rel=0.01, abs=1.0)
    assert np.diff(chosen).min() >= 0.5 / rate_hz - 2e-6


@pytest.mark.parametrize("is_known", [True, False])
@pytest.mark.parametrize(
    ("recorded_hz", "rate_hz", "step"),
    [(10, 5, 2), (30, 10, 3), (30, 15, 2), (30, 5, 6), (25, 5, 5), (10, 10, 1)],
)
def test_stamps_without_jitter_give_every_nth_frame(
    recorded_hz: int, rate_hz: int, step: int, is_known: bool
) -> None:
    stamps = tuple(round(row / recorded_hz, 6) for row in range(2000))

    assert played(stamps, rate_hz, is_known=is_known) == list(stamps[::step])


@pytest.mark.parametrize("is_known", [True, False])
def test_after_a_gap_the_rate_is_as_before(is_known: bool) -> None:
    before, after = jittered(1, frames=300), tuple(stamp + 17.35 for stamp in jittered(2, frames=300))

    chosen = np.array(played(before + after, 10.0, is_known=is_known))

    assert (chosen <= before[-1]).sum() == 100
    assert (chosen >= after[0]).sum() == pytest.approx(100, abs=1)
    assert np.diff(chosen).min() >= 0.05 - 2e-6


def test_a_camera_at_the_own_rate_loses_no_frame_of_a_tenth_of_jitter() -> None:
    stamps = jittered(3, jitter=0.1)

    assert played(stamps, 30.0, is_known=False) == list(stamps)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(rate_hz: float) -> None:
    with pytest.raises(UsageError, match="not a finite number above 0"):
        Thinning(rate_hz)
