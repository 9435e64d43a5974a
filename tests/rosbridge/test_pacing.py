"""The pacing of messages to a client: free for one that answers in time, down to what a slow one reads."""

from __future__ import annotations

from rse_pf.extensions.rosbridge.pacing import Pacing


def until_free(pacing: Pacing, now: float, round_trip_s: float) -> float:
    """Let a client answer every ping after *round_trip_s*; return the time when it is sent freely."""
    while not pacing.is_free:
        now += pacing.wait_s(now) + round_trip_s
        pacing.note_pong(round_trip_s, now)
    return now


def test_after_a_late_pong_the_pause_is_half_of_its_delay_and_shrinks_with_prompt_ones() -> None:
    pacing = Pacing()
    now = until_free(pacing, 0.0, 0.001)
    pacing.note_late()
    assert pacing.is_slow
    pacing.note_pong(0.8, now)
    assert not pacing.is_free
    assert pacing.wait_s(now) == 0.4

    now += pacing.wait_s(now)
    pacing.note_pong(0.001, now)
    assert not pacing.is_slow
    assert 0.3 < pacing.wait_s(now) < 0.4
    assert until_free(pacing, now, 0.001) - now < 3.0
