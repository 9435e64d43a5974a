"""The scheduler: fair between robots, fresh within a stream, quick to refuse."""

from __future__ import annotations

import heapq
import math
import random
from collections import Counter

import pytest
from backend.scheduling.admitted import AdmittedScheduler, fall_behind, measure_turns, queued

from rse_pf.backend.scheduling.robot_shares import AGAIN_S, TOLD_S
from rse_pf.backend.scheduling.scheduler import INLINE_BYTES, QueuedCommand, Scheduler
from rse_pf.identity import RobotId


def run_order(scheduler: Scheduler, count: int) -> list[tuple[str, int]]:
    order = []
    for _ in range(count):
        started, _ = scheduler.start(0.0)
        assert started is not None
        order.append((started.robot.name, started.command.id))
        scheduler.done(started, 0.0)
    return order


def test_robots_take_turns_however_much_one_of_them_asks():
    scheduler = AdmittedScheduler(max_queue=4)
    for identity in range(4):
        scheduler.submit(queued("flood", identity), 0.0)
    scheduler.submit(queued("a", 1), 0.0)
    scheduler.submit(queued("b", 1), 0.0)

    assert run_order(scheduler, 6) == [
        ("flood", 0), ("a", 1), ("b", 1), ("flood", 1), ("flood", 2), ("flood", 3),
    ]  # fmt: skip


def test_tenants_take_turns_however_many_robots_one_of_them_has():
    scheduler = AdmittedScheduler(max_queue=4)
    for number in range(6):
        scheduler.submit(queued(f"many{number}", number, tenant="many"), 0.0)
    for number in range(2):
        scheduler.submit(queued(f"few{number}", number, tenant="few"), 0.0)

    assert [name for name, _ in run_order(scheduler, 8)] == [
        "many0", "few0", "many1", "few1", "many2", "many3", "many4", "many5",
    ]  # fmt: skip
    assert scheduler.waiting == 0


def test_a_tenant_with_one_robot_is_served_while_another_tenants_robots_are_refused():
    scheduler = AdmittedScheduler(max_queue=4)
    fall_behind(scheduler, turn_s=0.05)
    for number in range(200):
        Scheduler.submit(scheduler, queued(f"many{number}", tenant="many"))

    (refusal,) = scheduler.submit(queued("one-more", within=4.0, tenant="many"), 0.0)

    assert refusal.reason == "behind"
    assert scheduler.backlog(queued("alone", tenant="few"))[1] == pytest.approx(0.05)
    assert scheduler.submit(queued("alone", within=4.0, tenant="few"), 0.0) == []


def test_one_robot_never_has_two_commands_running():
    scheduler = AdmittedScheduler(max_queue=4)
    scheduler.submit(queued("a", 1), 0.0)
    scheduler.submit(queued("a", 2), 0.0)
    first, _ = scheduler.start(0.0)

    assert scheduler.start(0.0) == (None, [])
    assert first is not None
    scheduler.done(first, 0.0)
    second, _ = scheduler.start(0.0)
    assert second is not None
    assert second.command.id == 2


def test_robots_of_one_name_in_two_tenants_are_queued_and_run_apart():
    scheduler = AdmittedScheduler(max_queue=1)
    assert scheduler.submit(queued("a", 1, stream="cam", seq=9, tenant="acme"), 0.0) == []
    assert scheduler.submit(queued("a", 2, stream="cam", seq=1, tenant="rival"), 0.0) == []

    both = [scheduler.start(0.0)[0] for _ in range(2)]

    assert [(each.robot.tenant, each.command.id) for each in both if each] == [("acme", 1), ("rival", 2)]


def test_the_newest_frame_takes_the_place_of_the_one_that_waits():
    scheduler = AdmittedScheduler(max_queue=4)
    scheduler.submit(queued("a", 1, stream="cam", seq=1), 0.0)

    (refusal,) = scheduler.submit(queued("a", 2, stream="cam", seq=2), 0.0)

    assert (refusal.queued.command.id, refusal.error.code) == (1, "stale")
    assert run_order(scheduler, 1) == [("a", 2)]
    assert scheduler.waiting == 0


def test_an_older_frame_does_not_replace_a_newer_one():
    scheduler = AdmittedScheduler(max_queue=4)
    scheduler.submit(queued("a", 2, stream="cam", seq=2), 0.0)

    (refusal,) = scheduler.submit(queued("a", 1, stream="cam", seq=1), 0.0)

    assert (refusal.queued.command.id, refusal.error.code) == (1, "stale")
    assert run_order(scheduler, 1) == [("a", 2)]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({"stream": "cam", "keep": True}, {"stream": "cam"}),
        ({"stream": "cam"}, {"stream": "cam", "keep": True}),
        ({"stream": "left"}, {"stream": "right"}),
        ({"stream": ""}, {"stream": ""}),
    ],
)
def test_kept_frames_other_streams_and_no_stream_are_not_replaced(first, second):
    scheduler = AdmittedScheduler(max_queue=4)

    assert scheduler.submit(queued("a", 1, **first), 0.0) == []
    assert scheduler.submit(queued("a", 2, **second), 0.0) == []
    assert run_order(scheduler, 2) == [("a", 1), ("a", 2)]


def test_streams_of_two_robots_do_not_meet():
    scheduler = AdmittedScheduler(max_queue=4)
    scheduler.submit(queued("a", 1, stream="cam"), 0.0)

    assert scheduler.submit(queued("b", 2, stream="cam", seq=5), 0.0) == []


def test_an_expired_command_costs_no_compute():
    scheduler = AdmittedScheduler(max_queue=4)
    scheduler.submit(queued("a", 1, within=0.03), 0.0)
    scheduler.submit(queued("b", 2), 0.0)

    started, refusals = scheduler.start(0.04)

    assert started is not None
    assert started.command.id == 2
    assert [(r.queued.command.id, r.error.code) for r in refusals] == [(1, "expired")]


def test_a_command_without_time_is_expired_at_once():
    (refusal,) = AdmittedScheduler(max_queue=4).submit(queued("a", within=0.0), 0.0)

    assert refusal.error.code == "expired"


def test_expired_commands_are_answered_although_nothing_starts():
    scheduler = AdmittedScheduler(max_queue=4)
    scheduler.submit(queued("a", 1), 0.0)
    scheduler.start(0.0)
    scheduler.submit(queued("a", 2, within=0.02), 0.0)

    assert [r.error.code for r in scheduler.sweep(0.03)] == ["expired"]
    assert scheduler.waiting == 0


def test_one_robot_waits_with_a_bound():
    scheduler = AdmittedScheduler(max_queue=4)
    for identity in range(4):
        scheduler.submit(queued("a", identity), 0.0)

    (refusal,) = scheduler.submit(queued("a", 9), 0.0)

    assert refusal.error.code == "busy"
    assert refusal.error.retry_after_ms is not None
    assert scheduler.submit(queued("b", 1), 0.0) == []


def test_a_connection_that_ends_takes_its_waiting_commands_along():
    scheduler = AdmittedScheduler(max_queue=4)
    scheduler.submit(queued("a", 1), 0.0)
    scheduler.submit(queued("b", 2), 0.0)

    assert [j.command.id for j in scheduler.leave("a")] == [1]
    assert run_order(scheduler, 1) == [("b", 2)]
    assert scheduler.start(0.0) == (None, [])


def test_only_a_small_cheap_command_that_is_alone_runs_inline():
    scheduler = AdmittedScheduler(max_queue=4)
    scheduler.submit(queued("a", 1), 0.0)
    scheduler.start(0.0)

    assert scheduler.runs_inline(cheap=True, size_bytes=INLINE_BYTES)
    assert not scheduler.runs_inline(cheap=True, size_bytes=INLINE_BYTES + 1)
    assert not scheduler.runs_inline(cheap=False, size_bytes=1)
    scheduler.submit(queued("b", 1), 0.0)
    assert not scheduler.runs_inline(cheap=True, size_bytes=1)
    scheduler.start(0.0)
    assert not scheduler.runs_inline(cheap=True, size_bytes=1)


WORK_S, DEADLINE_S, SWEEP_S, SECONDS = 0.005, 0.25, 0.025, 10.0
CAPACITY = 1 / WORK_S


def simulate(
    queue, arrivals: list[tuple[float, str]], jitter: random.Random
) -> tuple[list[QueuedCommand], int, list[float]]:
    """Serve *arrivals* with one server; return the good ones, how many were late, refusals' delays."""
    good: list[QueuedCommand] = []
    late, refused, now, i, swept = 0, [], 0.0, 0, 0.0

    def arrive(until: float) -> int:
        nonlocal i
        while i < len(arrivals) and arrivals[i][0] <= until:
            at, robot = arrivals[i]
            gone = queue.submit(queued(robot, i, at=at, within=DEADLINE_S), at)
            refused.extend([0.0] * len(gone))
            i += 1
        return i

    while now < SECONDS:
        arrive(now)
        if now - swept >= SWEEP_S:
            swept = now
            refused.extend(now - r.queued.received_s for r in queue.sweep(now))
        started, gone = queue.start(now)
        refused.extend(now - r.queued.received_s for r in gone)
        if started is None:
            now = arrivals[i][0] if i < len(arrivals) else SECONDS
            continue
        now += WORK_S * jitter.uniform(0.7, 1.3)
        arrive(now)
        queue.done(started, now)
        if now <= started.deadline_s:
            good.append(started)
        else:
            late += 1
    return good, late, refused


def drive(
    load: float, *, obeys: bool = False, hears_rate: bool = False, seconds: float = 12.0, robots: int = 40
) -> tuple[float, float, float]:
    """Let robots send at *load* times the capacity for two thirds of the time, then at half of it.

    Returns what was offered and served a second in the last 4 s of the overload, in shares of the capacity,
    and the time (s) from its end to the last refusal.
    """
    scheduler, chance = AdmittedScheduler(), random.Random(7)
    ends_s = 2 * seconds / 3
    period_s = robots / (load * CAPACITY)
    due = [(chance.uniform(0.0, period_s), number) for number in range(robots)]
    heapq.heapify(due)
    told_s, rated_until_s, gaps_s = [-1.0] * robots, [-math.inf] * robots, [0.0] * robots
    now, swept, offered, served, last_refusal_s = 0.0, 0.0, 0, 0, ends_s

    def arrive(until: float) -> None:
        nonlocal offered, last_refusal_s, rated_until_s
        while due and due[0][0] <= until:
            at, number = heapq.heappop(due)
            own_s = period_s if at < ends_s else 2 * robots / CAPACITY
            is_measured = ends_s - 4.0 <= at < ends_s
            offered += is_measured
            next_s = at + own_s * chance.uniform(0.5, 1.5)
            if at < rated_until_s[number]:
                next_s = max(next_s, at + gaps_s[number])
            scheduler.shares.note(RobotId("default", f"r{number}"))
            if scheduler.is_behind:
                if scheduler.shares.has_room:
                    rated_until_s = [-math.inf] * robots
                elif -TOLD_S < rated_until_s[number] - at < AGAIN_S:
                    rated_until_s[number] = at + TOLD_S
                    gaps_s[number] = 1 / (scheduler.shares.per_s * scheduler.shares.next_spread())
            if at < told_s[number] + scheduler.pause_s:
                scheduler.note_refused(at, is_early=True)
                gone = True
            else:
                spread = scheduler.shares.next_spread()
                retry_ms = spread * scheduler.refuse_unread(f"r{number}", DEADLINE_S, at)
                refusals = (
                    [] if retry_ms else scheduler.submit(queued(f"r{number}", at=at, within=DEADLINE_S), at)
                )
                gone = bool(retry_ms or refusals)
                if gone:
                    told_s[number] = at + (spread - 1.0) * scheduler.pause_s
                    share_per_s = scheduler.shares.per_s
                    if hears_rate and share_per_s and at >= rated_until_s[number]:
                        rated_until_s[number] = at + TOLD_S
                        gaps_s[number] = 1 / (share_per_s * scheduler.shares.next_spread())
                    if obeys:
                        waits_s = 1e-3 * (retry_ms or refusals[0].error.retry_after_ms)
                        next_s = max(next_s, at + waits_s)
            if gone:
                last_refusal_s = max(last_refusal_s, at)
            heapq.heappush(due, (next_s, number))

    while now < seconds:
        arrive(now)
        if now - swept >= SWEEP_S:
            swept = now
            scheduler.sweep(now)
        started, _ = scheduler.start(now)
        if started is None:
            now = max(now + 1e-4, due[0][0])
            continue
        now += WORK_S * chance.uniform(0.7, 1.3)
        arrive(now)
        scheduler.done(started, now)
        served += ends_s - 4.0 <= now < ends_s and now <= started.deadline_s
    return offered / (4.0 * CAPACITY), served / (4.0 * CAPACITY), last_refusal_s - ends_s


def test_a_pause_becomes_longer_while_many_are_refused_and_shorter_afterwards():
    scheduler = AdmittedScheduler()
    fall_behind(scheduler)
    pauses = []
    for interval in range(1, 40):
        for _ in range(20):  # those that come too early keep it behind
            scheduler.note_refused(0.11 * interval, is_early=interval > 10)
        pauses.append(scheduler.pause_s)

    assert pauses[:10] == sorted(pauses[:10])
    assert pauses[9] == max(pauses) == pytest.approx(0.65)
    assert pauses[10:] == sorted(pauses[10:], reverse=True)
    assert pauses[-1] == pytest.approx(0.1)


@pytest.mark.parametrize(("load", "most"), [(1.5, 1.25), (2.0, 1.35), (3.0, 1.6)])
def test_robots_that_obey_offer_little_more_than_can_be_served(load: float, most: float):
    offered, served, recovery_s = drive(load, obeys=True)

    assert offered <= most
    assert served >= 0.95
    assert recovery_s <= 1.0


@pytest.mark.parametrize(("load", "least"), [(1.5, 0.95), (2.0, 0.95), (3.0, 0.9)])
def test_robots_that_keep_to_their_share_offer_what_can_be_served(load: float, least: float):
    offered, served, recovery_s = drive(load, obeys=True, hears_rate=True)

    assert offered <= 1.2
    assert served >= least
    assert recovery_s <= 1.0


@pytest.mark.parametrize("load", [1.2, 2.0, 3.0])
def test_robots_that_ignore_pauses_take_nothing_and_the_server_recovers(load: float):
    _, served, recovery_s = drive(load, obeys=False)

    assert served >= 0.95
    assert recovery_s <= 1.0


def poisson(rate: float, robots: int, seed: int) -> list[tuple[float, str]]:
    rng, now, found = random.Random(seed), 0.0, []
    while now < SECONDS:
        now += rng.expovariate(rate)
        found.append((now, f"robot-{rng.randrange(robots)}"))
    return found


@pytest.mark.parametrize("robots", [4, 9, 40, 400])
@pytest.mark.parametrize("load", [2, 5])
def test_goodput_holds_under_overload(load, robots):
    arrivals = poisson(load * CAPACITY, robots, seed=load)

    good, late, refused = simulate(AdmittedScheduler(), arrivals, random.Random(1))

    assert len(good) >= 0.95 * CAPACITY * SECONDS
    assert late <= 0.02 * len(good)
    assert sorted(refused)[int(0.99 * len(refused))] <= DEADLINE_S / 2 + 2 * SWEEP_S


def test_nothing_is_shed_below_capacity():
    good, late, refused = simulate(AdmittedScheduler(), poisson(0.7 * CAPACITY, 40, 3), random.Random(1))

    assert late == 0
    assert len(refused) <= 0.01 * len(good)


def test_a_burst_shorter_than_the_interval_is_served_whole():
    burst = [(0.001 * k, f"r{k}") for k in range(28)]

    good, late, refused = simulate(AdmittedScheduler(), burst, random.Random(1))

    assert (len(good), late, refused) == (28, 0, [])


def test_one_robot_may_wait_for_a_slow_command_of_another():
    scheduler = AdmittedScheduler(max_queue=4)
    scheduler.submit(queued("slow"), 0.0)
    slow, _ = scheduler.start(0.0)
    assert slow is not None
    scheduler.submit(queued("a", at=0.01), 0.01)

    refusals = [r for k in range(1, 12) for r in scheduler.sweep(0.025 * k)]
    scheduler.done(slow, 0.3)

    assert refusals == []
    started, _ = scheduler.start(0.3)
    assert started is not None
    assert started.robot.name == "a"


def test_slow_services_below_capacity_are_not_shed():
    scheduler = AdmittedScheduler(max_queue=4)
    refused, now, i = [], 0.0, 0
    arrivals = sorted((1.0 * k + 0.1 * robot, f"r{robot}") for k in range(10) for robot in range(3))
    while i < len(arrivals) or scheduler.waiting:
        while i < len(arrivals) and arrivals[i][0] <= now:
            at, robot = arrivals[i]
            refused += scheduler.submit(queued(robot, i, at=at, within=5.0), at)
            i += 1
        refused += scheduler.sweep(now)
        started, gone = scheduler.start(now)
        refused += gone
        if started is None:
            now = arrivals[i][0] if i < len(arrivals) else now
            continue
        now += 0.3
        scheduler.done(started, now)

    assert refused == []


def test_no_robot_starves_under_overload():
    arrivals = poisson(5 * CAPACITY, 40, seed=9)

    good, _, _ = simulate(AdmittedScheduler(), arrivals, random.Random(1))

    served = Counter(each.robot.name for each in good)
    assert len(served) == 40
    assert min(served.values()) >= 0.75 * len(good) / 40


def test_a_flooding_robot_takes_nothing_from_the_others():
    calm = poisson(0.4 * CAPACITY, 20, seed=5)
    flood = [(at, "flood") for at, _ in poisson(10 * CAPACITY, 1, seed=6)]

    good, _, _ = simulate(AdmittedScheduler(), sorted(calm + flood), random.Random(1))

    served = Counter(each.robot.name for each in good)
    calm_served = sum(count for robot, count in served.items() if robot != "flood")
    assert calm_served >= 0.99 * len(calm)


def test_the_server_stops_shedding_when_the_load_is_over():
    scheduler = AdmittedScheduler(max_queue=4)
    for second in range(3):
        for robot in range(400):
            scheduler.submit(queued(f"r{robot}", at=second, within=0.4), float(second))
        scheduler.sweep(second + 0.06)
        scheduler.sweep(second + 0.2)
    assert scheduler.is_behind

    while scheduler.start(3.0)[0] is not None:
        pass
    calm_s = [3.2 + 0.11 * interval for interval in range(12)]
    was_behind = []
    for now in calm_s:
        scheduler.start(now)
        was_behind.append(scheduler.is_behind)

    assert was_behind[4], "robots that obey would all return at once"
    assert not was_behind[-1]
    assert scheduler.waiting == 0


def test_a_server_that_falls_behind_again_is_not_let_off_by_the_calm_of_the_last_time():
    scheduler = AdmittedScheduler()
    for began_s in (0.0, 10.0):
        fall_behind(scheduler, now=began_s)
        for interval in range(1, 6):
            scheduler.start(began_s + 0.11 * interval)
            assert scheduler.is_behind
        scheduler.start(began_s + 0.66)
        assert not scheduler.is_behind


def test_a_server_with_as_much_to_do_as_it_can_serve_is_behind_for_three_calm_seconds():
    scheduler = AdmittedScheduler()
    fall_behind(scheduler)
    was_behind = []
    for interval in range(60):
        for step in range(11):
            at = 0.01 * (11 * interval + step)
            scheduler.submit(queued("r", at=at), at)
            started, _ = scheduler.start(at)
            assert started is not None
            scheduler.done(started, at + 0.001)
        was_behind.append(scheduler.is_behind)

    assert was_behind[25]
    assert not was_behind[40]


def test_an_average_turn_is_steady_although_sockets_are_read_after_each_ten_of_them():
    scheduler, turns = AdmittedScheduler(), []
    now = 1.0
    for start in range(2000):
        now += 0.005 if start % 10 == 0 else 0.0001
        scheduler.submit(queued("r", at=now - 0.1), now - 0.1)
        started, _ = scheduler.start(now)
        assert started is not None
        scheduler.done(started, now)
        turns.append(scheduler.turn_s)

    mean_s = (0.005 + 9 * 0.0001) / 10
    assert 0.7 * mean_s <= min(turns[1000:])
    assert max(turns[1000:]) <= 1.3 * mean_s


def test_a_robot_that_keeps_to_its_share_pauses_no_longer_than_until_its_next_command():
    scheduler = AdmittedScheduler()
    fall_behind(scheduler, turn_s=1.0)
    for number in range(4):
        Scheduler.submit(scheduler, queued(f"r{number}"))
    robot = RobotId("default", "another")
    scheduler.shares.per_s = 5.0

    assert scheduler.retry_unread_ms(robot, 0.25, keeps_share=True) == pytest.approx(200.0)
    assert scheduler.retry_unread_ms(robot, 0.25) == pytest.approx(4000.0, rel=0.05)
    scheduler.shares.per_s = 0.0
    assert scheduler.retry_unread_ms(robot, 0.25, keeps_share=True) == pytest.approx(4000.0, rel=0.05)


@pytest.mark.parametrize("is_queued", [False, True])
def test_what_was_served_before_a_server_fell_behind_counts(is_queued: bool):
    scheduler = AdmittedScheduler()
    for step in range(300):
        at = 0.01 * step
        command = queued("r", at=at)
        if is_queued:
            scheduler.submit(command, at)
            assert scheduler.start(at)[0] is command
            scheduler.done(command, at)
        else:
            assert scheduler.start_unqueued(command, at)
            scheduler.finish_unqueued(command, at)
    fall_behind(scheduler, now=4.0)
    for number in range(10):
        scheduler.shares.note(RobotId("default", f"r{number}"))
    scheduler.shares.judge(5.0, 10, 10)

    assert scheduler.shares.per_s == pytest.approx(0.95 * 10.0, rel=0.05)


@pytest.mark.parametrize(
    ("is_enough", "is_easy", "calm_s"), [(True, True, 0.6), (True, False, 3.0), (False, True, 3.0)]
)
def test_a_server_stays_behind_for_longer_while_free_robots_would_send_too_much(
    is_enough: bool, is_easy: bool, calm_s: float
):
    scheduler = judged_for(calm_s - 0.1, is_enough=is_enough, is_easy=is_easy)
    assert scheduler.is_behind
    scheduler = judged_for(calm_s + 0.1, is_enough=is_enough, is_easy=is_easy)
    assert not scheduler.is_behind


def test_a_server_at_its_limit_stays_behind_while_free_robots_would_send_too_much():
    assert judged_for(30.0, is_enough=False, is_easy=False).is_behind


def judged_for(seconds: float, *, is_enough: bool, is_easy: bool) -> AdmittedScheduler:
    """Let calm intervals pass."""
    scheduler = AdmittedScheduler()
    fall_behind(scheduler)
    shares = scheduler.shares
    shares.judge = lambda *_: None  # type: ignore[method-assign]
    shares.is_enough, shares.is_easy = is_enough, is_easy
    began_s = scheduler._judged_s
    for interval in range(1, round(10 * seconds) + 1):
        at = began_s + 0.1001 * interval
        scheduler.submit(queued("r", at=at), at)
        started, _ = scheduler.start(at)
        if started is not None:
            scheduler.done(started, at)
    return scheduler


def test_nothing_is_refused_unread_before_the_server_is_behind():
    scheduler = AdmittedScheduler(max_queue=4)
    for i in range(50):
        scheduler.submit(queued(f"r{i}"), 0.0)

    assert scheduler.refuse_unread("new", 0.05, 0.0) == 0


def test_a_command_that_can_wait_is_admitted_where_a_hurried_one_is_refused():
    scheduler = AdmittedScheduler(max_queue=4)
    fall_behind(scheduler, turn_s=0.01)
    for i in range(50):
        scheduler.submit(queued(f"r{i}", within=5.0), 0.0)
    assert scheduler.waiting == 50

    assert scheduler.refuse_unread("new", 0.25, 0.01) > 0
    assert scheduler.submit(queued("hurried", within=0.25), 0.01)[0].error.code == "busy"
    assert scheduler.refuse_unread("new", 5.0, 0.01) == 0
    assert scheduler.submit(queued("unhurried", within=5.0), 0.01) == []
    assert scheduler.sweep(3.4) == [], "five seconds without the reserve"
    assert scheduler.refuse_unread("new", 0.25, 3.45) > 0, "so it is still behind"
    assert len(scheduler.sweep(3.52)) == 50, "all but the one whose turn it is"


def test_the_waiting_commands_of_a_robot_itself_count_as_rounds():
    scheduler = AdmittedScheduler(max_queue=4)
    fall_behind(scheduler, turn_s=0.02)
    for number in range(3):
        for i in range(60):
            scheduler.submit(queued(f"r{i}", number, within=5.0), 0.0)

    assert scheduler.submit(queued("r0", 3, within=5.0), 0.0), "it would wait for all, more than it can spare"
    assert scheduler.submit(queued("new", within=5.0), 0.0) == [], "it waits for one round"


def behind_with_one_waiting(turn_s: float) -> AdmittedScheduler:
    scheduler = AdmittedScheduler(max_queue=4)
    fall_behind(scheduler, turn_s=turn_s)
    scheduler.submit(queued("a"), 0.0)
    return scheduler


def test_a_server_that_is_behind_admits_another_robot_only_to_a_short_queue():
    assert behind_with_one_waiting(0.024).refuse_unread("new", 0.05, 0.01) == 0
    assert behind_with_one_waiting(0.024).refuse_unread("a", 0.05, 0.01) > 0
    assert behind_with_one_waiting(0.026).refuse_unread("new", 0.05, 0.01) > 0


def test_a_command_is_refused_before_decoding_if_its_turn_would_come_too_late():
    scheduler = Scheduler()
    measure_turns(scheduler, 0.2, 0.0)
    scheduler.submit(queued("a", within=60.0))
    robot = RobotId("default", "b")
    assert scheduler.retry_unread_ms(robot, 0.25) == 0, "the server is not behind"
    fall_behind(scheduler, now=0.5)

    assert scheduler.retry_unread_ms(robot, 0.25) == pytest.approx(200.0)
    assert scheduler.retry_unread_ms(robot, 5.0) == 0, "it has more time than compute and network need"


def test_a_frame_that_may_replace_a_waiting_one_is_always_decoded():
    scheduler = AdmittedScheduler(max_queue=4)
    measure_turns(scheduler, 1.0, -1.0)
    scheduler.submit(queued("a", 1, stream="cam", seq=1), 0.0)
    scheduler.submit(queued("b", 1), 0.0)
    assert scheduler.sweep(0.06) == scheduler.sweep(0.2) == []
    assert scheduler.is_behind

    assert scheduler.refuse_unread("a", 0.05, 0.21) == 0
    assert scheduler.refuse_unread("b", 0.05, 0.21) > 0


def test_a_command_whose_turn_would_come_after_half_of_its_time_is_refused_at_once():
    scheduler = AdmittedScheduler(max_queue=4)
    measure_turns(scheduler, 0.1, 0.0)
    for i in range(4):
        scheduler.submit(queued(f"r{i}"), 0.0)

    (refusal,) = scheduler.submit(queued("short", within=0.25), 0.0)

    assert refusal.error.code == "busy"
    assert refusal.error.retry_after_ms is not None
    assert scheduler.submit(queued("long", within=5.0), 0.0) == []


def test_a_server_that_refuses_half_of_its_commands_stays_behind_however_short_the_queue():
    scheduler = AdmittedScheduler(max_queue=4)
    fall_behind(scheduler, turn_s=0.1)
    for step in range(20):
        now = step * 0.05
        scheduler.submit(queued(f"in-{step}", at=now), now)
        assert scheduler.refuse_unread("out", 0.05, now) > 0
        started, _ = scheduler.start(now)
        assert started is not None
        scheduler.done(started, now)

    assert scheduler.is_behind


def test_one_long_pause_does_not_make_the_server_refuse_for_ever():
    scheduler = AdmittedScheduler(max_queue=4)
    fall_behind(scheduler, turn_s=3.0)
    now, refused = 0.0, 0
    for step in range(400):
        now = step * 0.02
        for robot in ("a", "b"):
            if scheduler.refuse_unread(robot, 0.05, now) == 0:
                refused += bool(scheduler.submit(queued(f"{robot}{step}", at=now), now)) and step > 300
            else:
                refused += step > 300
        for later in (now + 0.005, now + 0.01):
            started, _ = scheduler.start(later)
            if started is not None:
                scheduler.done(started, later)

    assert refused == 0
    assert not scheduler.is_behind


def test_the_solver_thread_leaves_its_work_to_the_loop_only_while_behind():
    scheduler = AdmittedScheduler(max_queue=4)
    scheduler.submit(queued("a"), 0.0)
    scheduler.submit(queued("b"), 0.0)
    scheduler.start(0.0)
    assert not scheduler.runs_inline(cheap=True, size_bytes=1)
    fall_behind(scheduler, now=1.0)

    assert scheduler.runs_inline(cheap=True, size_bytes=1)
    assert not scheduler.runs_inline(cheap=False, size_bytes=1)
