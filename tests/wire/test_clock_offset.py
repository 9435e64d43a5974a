"""Clock offset and one-way delays, against clocks whose offset is known."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.wire.clock_offset import ClockOffset, Exchange

delays = st.floats(0, 2)


def exchange(
    up_s: float, down_s: float, offset_s: float, sent_s: float = 10.0, held_s: float = 0.01
) -> Exchange:
    """Return the ping that a server whose clock is *offset_s* ahead would answer."""
    received_s = sent_s + up_s + offset_s
    returned_s = sent_s + up_s + held_s + down_s
    return Exchange(sent_s, received_s, received_s + held_s, returned_s)


def delays_of(clock: ClockOffset, command: Exchange) -> tuple[float | None, float | None]:
    return clock.split_s(command.sent_s, command.received_s, command.answered_s, command.returned_s)


def test_equal_ways_give_the_exact_offset():
    clock = ClockOffset()

    clock.add(exchange(0.02, 0.02, offset_s=-3600.0))

    assert clock.offset_s == pytest.approx(-3600.0, abs=1e-9)
    sent = exchange(0.02, 0.02, -3600.0, sent_s=5000.0)
    assert delays_of(clock, sent) == pytest.approx((0.02, 0.02), abs=1e-9)


@given(st.lists(st.tuples(delays, delays), min_size=1, max_size=20), st.floats(-1e5, 1e5))
def test_the_offset_is_never_further_off_than_half_the_shortest_round_trip(ways, offset_s):
    clock = ClockOffset()

    for up_s, down_s in ways:
        clock.add(exchange(up_s, down_s, offset_s))

    shortest_s = min(up_s + down_s for up_s, down_s in ways[-8:])  # a clock remembers eight exchanges
    assert abs(clock.offset_s - offset_s) <= 0.5 * shortest_s + 1e-9


def test_the_exchange_that_waited_least_is_believed():
    clock = ClockOffset()

    for up_s in (0.5, 0.01, 0.9):
        clock.add(exchange(up_s, 0.01, offset_s=7.0))

    assert clock.offset_s == pytest.approx(7.0)


def test_old_exchanges_are_forgotten_so_that_drift_is_followed():
    clock = ClockOffset(window=4)

    clock.add(exchange(0.001, 0.001, offset_s=0.0))
    for _ in range(4):
        clock.add(exchange(0.02, 0.02, offset_s=1.0))

    assert clock.offset_s == pytest.approx(1.0)


def test_the_two_delays_tell_a_slow_uplink_from_a_slow_downlink():
    clock = ClockOffset()
    clock.add(exchange(0.01, 0.01, offset_s=5.0))

    assert delays_of(clock, exchange(0.2, 0.01, offset_s=5.0)) == pytest.approx((0.2, 0.01))


@pytest.mark.parametrize(
    "stamps",
    [(1.0, math.nan, 2.0, 3.0), (1.0, 2.0, math.inf, 3.0), (3.0, 1.0, 1.0, 2.0), (1.0, 5.0, 4.0, 2.0)],
)
def test_invalid_timestamps_are_not_plausible(stamps):
    assert not Exchange(*stamps).is_plausible
