"""Pauses between attempts to connect, on a fake clock: never more attempts than the firewall allows."""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from random import Random

import pytest

from client_sdk.network.backoff import Backoff
from client_sdk.network.connect_timings import ConnectTimings
from client_sdk.network.dial_errors import DialError
from rse_pf.config import PlatformSettings
from rse_pf.config.front_door import DIAL_BURST, DIALS_PER_MINUTE
from rse_pf.errors import ConnectError
from tests.kit.fake_firewall import PlayedFirewall, rules_of_settings

SITE = "203.0.113.7"
BEGAN_S = 1000.0
ANSWERED = DialError(ConnectError("closed"))
UNANSWERED = DialError(ConnectError("no route"), is_unanswered=True)
REFUSED = DialError(ConnectError("refused"), is_refusal=True)


def _backoff(timings: ConnectTimings, random: Random) -> Backoff:
    return Backoff(timings, random, wall_clock=lambda: 0.0)


def _revoked(valid_in_s: float) -> DialError:
    return DialError(ConnectError("revoked"), is_refusal=True, valid_from_s=valid_in_s)


@dataclass
class Outage:
    """Result of an outage for robots behind one IP address: times of reconnects, and blocked attempts."""

    connected_s: list[float]
    blocked: int
    most_per_minute: int


def play(settings: PlatformSettings, *, robots: int, outage_s: float, seed: int = 0) -> Outage:
    """Disconnect all robots at once; the load balancer answers 503, and the firewall applies its rules."""
    firewall = PlayedFirewall(rules_of_settings(settings))
    backoffs = [_backoff(ConnectTimings(), Random(f"{seed}/{robot}")) for robot in range(robots)]
    due = [(BEGAN_S + each.pause_s(BEGAN_S, ANSWERED), robot) for robot, each in enumerate(backoffs)]
    heapq.heapify(due)
    connected_s: list[float] = []
    dials: list[list[float]] = [[] for _ in range(robots)]
    while due:
        now, robot = heapq.heappop(due)
        dials[robot].append(now)
        backoffs[robot].count_attempt(now)
        reply = firewall.judge(SITE, "/ws", now)
        if reply is None and now >= BEGAN_S + outage_s:
            connected_s.append(now - BEGAN_S)
            continue
        asked_s = 0.0 if reply is None else float(reply.headers["Retry-After"])
        failure = DialError(ConnectError("full"), retry_after_s=asked_s)
        heapq.heappush(due, (now + backoffs[robot].pause_s(now, failure), robot))
    most = max(_most_within_a_minute(each) for each in dials)
    return Outage(sorted(connected_s), firewall.blocked, most)


def _most_within_a_minute(times: list[float]) -> int:
    return max(sum(begin <= each < begin + 60.0 for each in times) for begin in times)


@pytest.mark.parametrize("robots", [40, 100])
@pytest.mark.parametrize("seed", range(3))
def test_robots_behind_one_address_are_back_within_30_s_of_an_outage_of_60_s(robots, seed):
    outage = play(PlatformSettings(), robots=robots, outage_s=60.0, seed=seed)

    assert outage.blocked == 0
    assert outage.connected_s[-1] <= 60.0 + 30.0
    assert len(outage.connected_s) == robots


@pytest.mark.parametrize("outage_s", [5.0, 60.0, 600.0])
def test_no_robot_dials_more_often_than_the_limit_is_derived_from(outage_s):
    settings = PlatformSettings()
    bound = DIAL_BURST + DIALS_PER_MINUTE

    outage = play(settings, robots=20, outage_s=outage_s)

    assert outage.most_per_minute <= bound


def test_a_server_that_accepts_and_dies_again_and_again_does_not_empty_the_allowance():
    timings = ConnectTimings()
    backoff, now, dials = _backoff(timings, Random(1)), 0.0, 0
    while now < 600.0:
        now += backoff.pause_s(now, ANSWERED)
        backoff.count_attempt(now)
        dials += 1
        now += 1.5  # longer than reconnect_max_s: counts as a connection that lasted
        backoff.reset()

    allowed = DIAL_BURST + 10 * DIALS_PER_MINUTE
    assert allowed - 2 <= dials <= allowed + 1


def test_a_server_that_dies_is_dialled_again_within_a_second():
    for seed in range(50):
        assert _backoff(ConnectTimings(), Random(seed)).pause_s(50.0, ANSWERED) <= 0.1


def test_robots_that_get_the_same_time_do_not_come_back_together():
    full = DialError(ConnectError("full"), retry_after_s=60.0)
    pauses = [_backoff(ConnectTimings(), Random(seed)).pause_s(0.0, full) for seed in range(100)]

    assert min(pauses) >= 60.0
    assert max(pauses) - min(pauses) >= 10.0


def test_attempts_that_nobody_answers_go_on_once_a_second_and_cost_no_allowance():
    backoff, now = _backoff(ConnectTimings(), Random(3)), 0.0
    pauses = []
    for _ in range(200):
        pauses.append(backoff.pause_s(now, UNANSWERED))
        now += pauses[-1]

    assert min(pauses) >= 1.0
    assert 1.2 <= max(pauses) <= 1.25


def test_a_robot_that_is_refused_tries_again_every_20_to_40_s_for_ever():
    backoff, now, pauses = _backoff(ConnectTimings(), Random(4)), 0.0, []
    while now < 7200.0:
        backoff.count_attempt(now)
        pauses.append(backoff.pause_s(now, REFUSED))
        now += pauses[-1]

    assert min(pauses) >= 20.0
    assert max(pauses) <= 40.0
    assert max(pauses) - min(pauses) >= 15.0


@pytest.mark.parametrize(("valid_in_s", "least_s"), [(-120.0, 0.0), (0.0, 0.0), (0.7, 0.7), (9.0, 9.0)])
def test_after_a_cut_off_a_robot_is_back_half_a_second_after_its_tokens_are_late_enough(valid_in_s, least_s):
    for seed in range(50):
        pause_s = _backoff(ConnectTimings(), Random(seed)).pause_s(5.0, _revoked(valid_in_s))

        assert least_s <= pause_s <= least_s + 0.5


def test_a_cut_off_far_away_by_a_wrong_clock_does_not_keep_a_robot_from_trying():
    assert _backoff(ConnectTimings(), Random(1)).pause_s(0.0, _revoked(1e6)) <= 40.0


def test_refusals_cost_the_allowance_of_the_firewall_like_every_other_answer():
    timings = ConnectTimings()
    backoff = _backoff(timings, Random(1))
    for _ in range(DIAL_BURST):
        backoff.count_attempt(0.0)

    assert backoff.pause_s(0.0, _revoked(0.0)) >= 60.0 / DIALS_PER_MINUTE
