"""The rate of robots and addresses, bans, and pending handshakes."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.config import ServingSettings, SessionSettings
from rse_pf.http.unauthenticated import PendingHandshakes
from rse_pf.identity import RobotId
from rse_pf.limits.token_bucket import TokenBucket
from rse_pf.server.gateway.rate_limits import CUT_OFF, RobotRates, SourceRates

ROBOT = RobotId("default", "r")
LIMITS = SessionSettings(max_commands_per_s=20.0)


def judged(rates: RobotRates, per_s: float, seconds: float, robot: tuple[str, str] = ROBOT) -> list[float]:
    return [rates.retry_after_ms(robot, 100.0 + k / per_s) for k in range(int(per_s * seconds))]


def test_a_bucket_gives_its_burst_then_its_rate():
    bucket = TokenBucket(10.0, 3.0)

    assert [bucket.take(5.0) for _ in range(3)] == [0.0, 0.0, 0.0]
    assert bucket.take(5.0) == pytest.approx(0.1)
    assert bucket.take(5.1) == pytest.approx(0.0, abs=1e-9)


@given(
    gaps=st.lists(st.floats(0.0, 2.0), min_size=1, max_size=200),
    rate=st.floats(0.5, 50.0),
    burst=st.integers(1, 50),
)
def test_no_span_of_time_gives_more_than_burst_and_rate_together(gaps, rate, burst):
    bucket, now, taken = TokenBucket(rate, float(burst)), 0.0, []
    for gap in gaps:
        now += gap
        if bucket.take(now) == 0.0:
            taken.append(now)

    for first, begin in enumerate(taken):
        for count, end in enumerate(taken[first:], start=1):
            assert count <= burst + rate * (end - begin) + 1e-6


def test_a_clock_that_stands_or_goes_back_gives_nothing():
    bucket = TokenBucket(10.0, 1.0)
    bucket.take(5.0)

    assert bucket.take(5.0) > 0
    assert bucket.take(4.0) == pytest.approx(0.1), "the wait does not grow either"


def test_five_frames_a_second_with_the_catch_up_of_a_long_cut_are_never_refused():
    rates = RobotRates(LIMITS)
    live = [100.0 + k / 5 for k in range(300)]
    caught_up = [130.0] * 16  # what was unanswered when the link came back, and eight pings

    assert all(rates.retry_after_ms(ROBOT, now) == 0 for now in sorted(live + caught_up))


def test_a_robot_a_little_above_its_rate_gets_the_time_to_try_again_and_never_cut_off():
    verdicts = judged(RobotRates(LIMITS), per_s=25.0, seconds=120.0)
    refused = [retry_ms for retry_ms in verdicts if retry_ms]

    assert CUT_OFF not in verdicts
    assert len(refused) == pytest.approx(120.0 * 5 - 40, abs=20)
    assert all(0 < retry_ms <= 50.0 for retry_ms in refused)


def test_a_robot_far_above_its_rate_is_cut_off_within_half_a_second_and_banned():
    rates = RobotRates(LIMITS)
    verdicts = judged(rates, per_s=500.0, seconds=0.5)
    cut_off = verdicts.index(CUT_OFF)

    assert 40 + 3 * 40 <= cut_off <= 180
    assert rates.banned_s(ROBOT, 100.0 + cut_off / 500) == pytest.approx(5.0)
    assert rates.banned_s(ROBOT, 106.0) == 0.0
    assert rates.banned_s(RobotId("default", "another"), 100.5) == 0.0


def test_the_number_of_remembered_names_is_bounded():
    rates, sources = RobotRates(LIMITS, max_names=100), SourceRates(ServingSettings(), max_names=100)

    for k in range(1000):
        rates.retry_after_ms(RobotId("default", f"r-{k}"), 100.0)
        sources.wait_s(f"10.0.0.{k}", 100.0)
        assert len(rates) <= 100
        assert len(sources) <= 100


def test_a_banned_robot_is_not_forgotten_for_names_that_did_nothing():
    rates = RobotRates(LIMITS, max_names=100)
    judged(rates, per_s=500.0, seconds=0.5)

    for k in range(400):
        rates.retry_after_ms(RobotId("default", f"r-{k}"), 101.0 + k / 100)

    assert rates.banned_s(ROBOT, 101.0) > 0


@pytest.mark.parametrize(
    ("trusted", "told", "source"),
    [
        (0, "10.0.0.9", "peer"),
        (1, "10.0.0.9", "10.0.0.9"),
        (1, "a lie, 10.0.0.9", "10.0.0.9"),
        (2, "a lie, 10.0.0.9, 10.0.0.1", "10.0.0.9"),
        (1, "", "peer"),
        (2, "10.0.0.9", "peer"),
        (1, "2001:db8::1", "2001:db8::1"),
        (1, f"10.0.0.9, {'x' * 8000}", "peer"),
        (1, "10.0.0.9, ok\x1b[2J", "peer"),
    ],
)
def test_the_source_is_the_address_that_the_first_trusted_proxy_saw(trusted, told, source):
    assert SourceRates(ServingSettings(trusted_proxies=trusted)).source("peer", told) == source


def test_the_pending_handshake_that_waited_longest_is_cut_for_a_new_one():
    pending: PendingHandshakes[int] = PendingHandshakes(max_sockets=3, max_per_source=0)

    assert [pending.enter(k, "a") for k in range(5)] == [None, None, None, 0, 1]
    assert len(pending) == 3


def test_a_source_with_too_many_pending_handshakes_loses_its_own():
    pending: PendingHandshakes[str] = PendingHandshakes(max_sockets=100, max_per_source=2)
    pending.enter("other", "b")

    assert [pending.enter(name, "a") for name in ("x", "y", "z")] == [None, None, "x"]
    assert pending.enter("other-2", "b") is None


def test_a_handshake_that_sent_its_token_is_no_longer_pending():
    pending: PendingHandshakes[int] = PendingHandshakes(max_sockets=2, max_per_source=2)
    pending.enter(1, "a")
    pending.enter(2, "a")
    pending.leave(1)
    pending.leave(1)

    assert pending.enter(3, "a") is None
    assert len(pending) == 2


@given(steps=st.lists(st.tuples(st.booleans(), st.integers(0, 9), st.integers(0, 3)), max_size=200))
def test_pending_handshakes_never_exceed_their_limits(steps):
    pending: PendingHandshakes[int] = PendingHandshakes(max_sockets=5, max_per_source=2)
    inside: dict[int, str] = {}
    for number, (enters, key, source) in enumerate(steps):
        if enters:
            inside[number] = str(source)
            leaving = pending.enter(number, str(source))
            if leaving is not None:
                del inside[leaving]
        elif inside:
            gone = list(inside)[key % len(inside)]
            pending.leave(gone)
            del inside[gone]
        assert len(pending) == len(inside) <= 5
        assert all(list(inside.values()).count(each) <= 2 for each in inside.values())


def test_robots_have_buckets_of_their_own():
    rates = RobotRates(LIMITS)
    judged(rates, per_s=500.0, seconds=0.5, robot=RobotId("a", "flood"))

    assert rates.retry_after_ms(RobotId("a", "calm"), 100.5) == 0
    assert rates.banned_s(RobotId("a", "flood"), 100.5) > 0
    assert rates.banned_s(RobotId("b", "flood"), 100.5) == 0, "a name belongs to its tenant"
    assert [rates.retry_after_ms(RobotId("b", "flood"), 100.5) for _ in range(3)] == [0, 0, 0]


def test_a_source_has_a_rate_of_handshakes(monkeypatch):
    monkeypatch.setattr("rse_pf.server.gateway.rate_limits.HANDSHAKE_BURST", 3.0)
    sources = SourceRates(ServingSettings(max_handshakes_per_source_per_s=10.0))

    assert [sources.wait_s("a", 1.0) > 0 for _ in range(5)] == [False, False, False, True, True]
    assert sources.wait_s("b", 1.0) == 0.0
    assert sources.wait_s("a", 1.2) == 0.0
