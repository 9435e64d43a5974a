"""Every rule about sandboxes: events and the time go in, actions come out, no process is started."""

from __future__ import annotations

from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest, RsePfError, StoreError
from rse_pf.identity import RobotId
from rse_pf.processes.ipc import encode_message
from rse_pf.server.sandbox.circuit_breaker import POISON_CRASHES, CircuitBreaker
from rse_pf.server.sandbox.policy import (
    START_TIMEOUT_S,
    Action,
    AnswerCall,
    CreateSandbox,
    KillSandbox,
    LoadSnapshot,
    LogEnd,
    ReleaseSandbox,
    SandboxCall,
    SandboxPolicy,
    SandboxReply,
    SaveSnapshot,
    SendMessage,
)
from rse_pf.server.scheduling.command_queue import QueuedCommand
from rse_pf.wire import Command

GRACE_S = 5.0
A, B, C = (RobotId("acme", name) for name in "abc")
KINDS = {"icp": "stateless", "counter": "per_robot_state"}


def make_policy(
    *,
    max_sandboxes: int = 4,
    keeps_snapshots: bool = True,
    poison_crashes: int = POISON_CRASHES,
    **services: Any,
) -> SandboxPolicy:
    """Return a policy that knows the connections of robots a, b and c."""
    limits = {"grace_s": GRACE_S, "breaker_crashes": 100, **services}
    settings = PlatformSettings.from_dict({"services": limits})
    policy = SandboxPolicy(
        KINDS, settings.services, max_sandboxes=max_sandboxes, keeps_snapshots=keeps_snapshots
    )
    policy.breaker = CircuitBreaker(settings.services, poison_crashes=poison_crashes)
    for robot in (A, B, C):
        policy.add_connection(robot)
    return policy


def make_call(
    robot: RobotId = A,
    service: str = "icp",
    *,
    payload: str = "x",
    now: float = 0.0,
    deadline_s: float = 10.0,
) -> SandboxCall:
    """Return a command that was received *now* and has *deadline_s* seconds."""
    command = Command(id=1, service=service, payload=payload)
    queued = QueuedCommand(None, robot, command, 10, now, now + deadline_s)
    return SandboxCall(queued, f"{service}/{payload}", payload.encode())


def start(policy: SandboxPolicy, call: SandboxCall, now: float = 0.0) -> int:
    """Submit *call* to a sandbox that is created for it, let it start, and return its number."""
    (create,) = policy.submit(call, now)
    assert isinstance(create, CreateSandbox)
    policy.on_ready(create.number, now)
    return create.number


def outcomes(actions: list[Action]) -> list[tuple[SandboxCall, str]]:
    """Return the answers among *actions* as call and "ok" or error code."""
    return [
        (each.call, each.outcome.code if isinstance(each.outcome, RsePfError) else "ok")
        for each in actions
        if isinstance(each, AnswerCall)
    ]


def created(actions: list[Action]) -> int:
    """Return the number of the one sandbox that *actions* create."""
    (number,) = (each.number for each in actions if isinstance(each, CreateSandbox))
    return number


OK = SandboxReply("done", 1.5)


# --- crashes: retry, poison, circuit breaker -------------------------------------------------------


def test_a_stateless_command_whose_sandbox_crashed_is_tried_once_more_in_a_new_one():
    policy, call = make_policy(), make_call()
    start(policy, call)

    actions = policy.on_exit(1, "signal SIGSEGV", 1.0)

    assert actions == [
        ReleaseSandbox(1), LogEnd(A, "icp", "signal SIGSEGV (signal SIGSEGV)", True), CreateSandbox(2, A)
    ]  # fmt: skip
    assert policy.on_ready(2, 1.5) == [SendMessage(2, b"x")]
    assert outcomes(policy.on_reply(2, OK, 2.0)) == [(call, "ok")]


def test_a_command_is_tried_twice_and_no_more():
    policy, call = make_policy(poison_crashes=10), make_call()
    start(policy, call)
    number = created(policy.on_exit(1, "exit code 1", 1.0))
    policy.on_ready(number, 1.0)

    actions = policy.on_exit(number, "exit code 1", 2.0)

    assert outcomes(actions) == [(call, "worker-lost")]
    assert policy.sandboxes == 0


def test_an_open_circuit_breaker_refuses_what_waits_as_well():
    policy = make_policy(breaker_crashes=2, poison_crashes=1)
    first, second, waiting = (make_call(payload=name) for name in "123")
    start(policy, first)
    policy.submit(second, 0.0)
    policy.submit(waiting, 0.0)
    number = created(policy.on_exit(1, "exit code 1", 1.0))
    policy.on_ready(number, 1.0)
    number = created(policy.on_exit(number, "exit code 1", 1.0))

    assert outcomes(policy.on_ready(number, 1.5)) == [(waiting, "worker-lost")]


def test_a_command_whose_deadline_has_passed_is_not_tried_again():
    policy, call = make_policy(), make_call(deadline_s=1.0)
    start(policy, call)

    assert outcomes(policy.on_exit(1, "exit code 1", 1.0)) == [(call, "worker-lost")]
    assert policy.sandboxes == 0


def test_a_command_to_state_that_no_snapshot_holds_is_not_tried_again():
    policy, call = make_policy(keeps_snapshots=False), make_call(service="counter")
    start(policy, call)

    assert outcomes(policy.on_exit(1, "exit code 1", 1.0)) == [(call, "worker-lost")]


def test_a_command_to_state_in_a_snapshot_is_restored_and_tried_again():
    policy, call = make_policy(), make_call(service="counter")
    start(policy, call)
    policy.on_store_reply(1, call, b"7", 0.1)
    policy.on_reply(1, SandboxReply(True, 0.1), 0.2)

    number = created(policy.on_exit(1, "exit code 1", 1.0))

    assert policy.on_ready(number, 1.0) == [LoadSnapshot(number, call)]


def test_commands_that_wait_move_to_the_new_sandbox_in_order():
    policy = make_policy(poison_crashes=1)
    running, second, third = (make_call(payload=name) for name in "123")
    start(policy, running)
    policy.submit(second, 0.0)
    policy.submit(third, 0.0)

    actions = policy.on_exit(1, "exit code 1", 1.0)
    number = created(actions)

    assert outcomes(actions) == [(running, "poison")]
    assert policy.on_ready(number, 1.0) == [SendMessage(number, b"2")]
    assert policy.on_reply(number, OK, 1.0) == [AnswerCall(second, OK), SendMessage(number, b"3")]


def test_the_retried_command_runs_before_those_that_waited_for_it():
    policy, running, second = make_policy(), make_call(payload="1"), make_call(payload="2")
    start(policy, running)
    policy.submit(second, 0.0)

    number = created(policy.on_exit(1, "exit code 1", 1.0))

    assert policy.on_ready(number, 1.0) == [SendMessage(number, b"1")]


def test_a_sandbox_that_ends_before_it_is_ready_fails_all_that_wait_and_is_not_replaced():
    policy, first, second = make_policy(), make_call(payload="1"), make_call(payload="2")
    policy.submit(first, 0.0)
    policy.submit(second, 0.0)

    actions = policy.on_exit(1, "exit code 1", 0.5)

    assert outcomes(actions) == [(first, "worker-lost"), (second, "worker-lost")]
    assert policy.sandboxes == 0


def test_the_end_of_the_zygote_is_evidence_against_no_service_and_no_request():
    policy = make_policy(breaker_crashes=2, poison_crashes=1)
    for i in range(3):
        for robot in (A, B, C):
            start(policy, make_call(robot, now=i), now=i)
        policy.on_all_exited("the zygote ended", i)
        for number in range(6 * i + 4, 6 * i + 7):
            policy.on_ready(number, i)
            policy.on_reply(number, OK, i)
        policy.on_all_exited("the zygote ended", i)

    assert created(policy.submit(make_call(now=3.0), 3.0))


# --- deadlines and kills ---------------------------------------------------------------------------


def overrun(policy: SandboxPolicy, call: SandboxCall, now: float) -> None:
    """Let *call* run to its deadline, and be killed at twice that."""
    number = start(policy, call, now)
    policy.tick(call.queued.deadline_s)
    policy.tick(2 * call.queued.deadline_s - call.queued.received_s)
    policy.on_exit(number, "signal SIGKILL", 2 * call.queued.deadline_s - call.queued.received_s)


def test_the_deadline_of_a_robot_is_no_evidence_for_others_and_its_request_no_poison():
    policy = make_policy(breaker_crashes=2, poison_crashes=1)
    for i in range(3):
        for robot in (A, B, C):
            overrun(policy, make_call(robot, now=100.0 * i, deadline_s=0.06), 100.0 * i)
    another = RobotId("acme", "d")
    policy.add_connection(another)

    assert policy.counts == {"created": 9, "overran": 9}
    assert created(policy.submit(make_call(A, now=300.0), 300.0)) == 10
    assert created(policy.submit(make_call(another, now=300.0), 300.0)) == 11


def test_a_robot_whose_sandbox_was_killed_repeatedly_for_its_deadline_is_refused_the_service():
    policy = make_policy(breaker_crashes=2)
    for now in (0.0, 1.0):
        overrun(policy, make_call(A, payload=str(now), now=now, deadline_s=0.06), now)
    refused, other = make_call(A, payload="x", now=2.0), make_call(B, payload="x", now=2.0)

    assert outcomes(policy.submit(refused, 2.0)) == [(refused, "worker-lost")]
    assert created(policy.submit(other, 2.0)) == 3


def test_a_late_reply_is_not_answered_again_and_lets_the_next_command_run():
    policy, call, second = make_policy(), make_call(deadline_s=1.0), make_call(payload="2")
    start(policy, call)
    policy.submit(second, 0.5)
    assert outcomes(policy.tick(1.0)) == [(call, "expired")]

    assert policy.on_reply(1, OK, 1.5) == [SendMessage(1, b"2")]
    assert policy.tick(1e9) != [], "the deadline of the second holds"


def test_a_command_that_waited_beyond_its_deadline_costs_no_compute():
    policy, running, late = make_policy(), make_call(payload="1"), make_call(payload="2", deadline_s=1.0)
    start(policy, running)
    policy.submit(late, 0.0)

    actions = policy.on_reply(1, OK, 1.0)

    assert outcomes(actions) == [(running, "ok"), (late, "expired")]
    assert not any(isinstance(each, SendMessage) for each in actions)


def test_a_sandbox_that_does_not_start_in_time_is_killed():
    policy, call = make_policy(), make_call()
    policy.submit(call, 0.0)
    assert policy.wake_s == START_TIMEOUT_S

    assert policy.tick(START_TIMEOUT_S) == [KillSandbox(1)]
    actions = policy.on_exit(1, "signal SIGKILL", START_TIMEOUT_S)

    assert outcomes(actions) == [(call, "worker-lost")]
    assert LogEnd(A, "", "it did not start in time (signal SIGKILL)", True) in actions


def test_a_sandbox_that_violates_the_protocol_is_killed():
    policy = make_policy()
    start(policy, make_call())
    assert policy.on_violation(1, "it sent an invalid message") == [KillSandbox(1)]

    policy = make_policy()
    start(policy, make_call())
    policy.on_reply(1, OK, 1.0)
    assert policy.on_reply(1, OK, 1.0) == [KillSandbox(1)], "a reply that nobody asked for"

    policy = make_policy()
    start(policy, make_call())
    assert policy.on_ready(1, 1.0) == [KillSandbox(1)], "ready for the second time"


def test_a_command_for_an_idle_sandbox_that_is_being_killed_waits_for_the_next_one():
    policy, second = make_policy(), make_call(payload="2")
    start(policy, make_call())
    policy.on_reply(1, OK, 1.0)
    policy.on_violation(1, "")

    assert policy.submit(second, 1.0) == []
    number = created(policy.on_exit(1, "exit code 0", 1.1))

    assert policy.on_ready(number, 1.2) == [SendMessage(number, b"2")]
    assert second.tries == 0


# --- connections, grace and capacity ---------------------------------------------------------------


def test_the_sandbox_of_a_robot_stays_when_one_of_the_same_name_in_another_tenant_leaves():
    policy, namesake = make_policy(), RobotId("rival", A.name)
    policy.add_connection(namesake)
    for robot in (A, namesake):
        policy.on_reply(start(policy, make_call(robot)), OK, 1.0)
    policy.remove_connection(namesake, 2.0)

    assert policy.tick(2.0 + GRACE_S) == [ReleaseSandbox(2)]


def test_a_robot_that_reconnects_within_the_grace_period_keeps_its_sandbox():
    policy = make_policy()
    start(policy, make_call())
    policy.on_reply(1, OK, 1.0)
    policy.remove_connection(A, 2.0)
    policy.add_connection(A)

    assert policy.tick(100.0) == []
    assert policy.submit(make_call(payload="2", now=100.0), 100.0) == [SendMessage(1, b"2")]


def test_commands_that_wait_for_a_robot_that_left_are_dropped_and_not_moved():
    policy = make_policy()
    start(policy, make_call(payload="1"))
    policy.submit(make_call(payload="2"), 0.0)
    policy.remove_connection(A, 1.0)
    assert policy.held == 1

    assert not any(isinstance(each, CreateSandbox) for each in policy.on_exit(1, "exit code 1", 1.5))


def test_an_idle_sandbox_in_its_grace_period_gives_its_place_to_another_robot():
    policy = make_policy(max_sandboxes=1)
    start(policy, make_call(A))
    policy.on_reply(1, OK, 1.0)
    policy.remove_connection(A, 1.0)

    assert policy.submit(make_call(B), 1.5) == [ReleaseSandbox(1), CreateSandbox(2, B)]


def test_a_sandbox_that_works_or_whose_robot_is_connected_keeps_its_place():
    policy = make_policy(max_sandboxes=2)
    start(policy, make_call(A))
    start(policy, make_call(B, payload="y"))
    policy.on_reply(2, OK, 0.5)
    policy.remove_connection(A, 1.0)
    call = make_call(C)

    assert outcomes(policy.submit(call, 1.5)) == [(call, "busy")]


RIVALS = [RobotId("rival", name) for name in "abcd"]


def taken_by_rivals(*, idle: bool) -> tuple[SandboxPolicy, list[SandboxCall]]:
    """Return a policy whose four places one tenant holds: all run, or became idle at 4, 3, 2 and 1 s."""
    policy, calls = make_policy(), [make_call(rival) for rival in RIVALS]
    for i, call in enumerate(calls):
        policy.add_connection(call.queued.robot)
        number = start(policy, call)
        if idle:
            policy.on_reply(number, OK, 4.0 - i)
    return policy, calls


def test_a_tenant_that_holds_all_places_loses_the_one_that_was_idle_longest_to_another_tenant():
    policy, _ = taken_by_rivals(idle=True)

    assert policy.submit(make_call(A), 5.0) == [ReleaseSandbox(4), CreateSandbox(5, A)]
    assert policy.submit(make_call(B), 5.0) == [ReleaseSandbox(3), CreateSandbox(6, B)]
    third = make_call(C)
    assert outcomes(policy.submit(third, 5.0)) == [(third, "busy")], "both tenants have two"


def test_a_tenant_whose_sandboxes_all_work_gives_up_the_first_that_ends_its_command():
    policy, calls = taken_by_rivals(idle=False)
    call, waiting = make_call(A, now=1.0), make_call(RIVALS[0], payload="2")
    policy.submit(waiting, 1.0)
    assert outcomes(policy.submit(call, 1.0)) == [(call, "busy")]

    actions = policy.on_reply(1, OK, 1.5)

    assert outcomes(actions) == [(calls[0], "ok"), (waiting, "busy")]
    assert ReleaseSandbox(1) in actions
    more = make_call(RIVALS[0], payload="3")
    assert outcomes(policy.submit(more, 1.6)) == [(more, "busy")], "the place is kept for who asked first"
    assert outcomes(policy.on_reply(2, OK, 1.7)) == [(calls[1], "ok")]
    assert policy.submit(make_call(A), 2.0) == [CreateSandbox(5, A)]


def test_a_crash_does_not_help_a_tenant_to_keep_a_place_that_another_one_claims():
    policy, _ = taken_by_rivals(idle=False)
    policy.submit(make_call(RIVALS[0], payload="2"), 1.0)
    policy.submit(make_call(A), 1.0)

    actions = policy.on_exit(1, "exit code 1", 1.5)

    assert not any(isinstance(each, CreateSandbox) for each in actions)
    assert [code for _, code in outcomes(actions)] == ["busy", "busy"]


def test_the_last_snapshot_is_restored_before_the_first_command_and_only_once():
    policy, call = make_policy(), make_call(service="counter")
    policy.submit(call, 0.0)

    assert policy.on_ready(1, 0.0) == [LoadSnapshot(1, call)]
    assert policy.on_store_reply(1, call, b"7", 0.1) == [
        SendMessage(1, encode_message(["restore", "counter", b"7"]))
    ]
    assert policy.on_reply(1, SandboxReply(True, 0.1), 0.2) == [SendMessage(1, b"x")]
    policy.on_reply(1, SandboxReply("done", 1.0, b"7"), 0.3)
    assert policy.submit(make_call(service="counter", payload="2"), 1.0) == [SendMessage(1, b"2")]


# --- state that outlives a sandbox -----------------------------------------------------------------


def run_counter(policy: SandboxPolicy, stored: bytes | None = b"1") -> SandboxCall:
    """Submit a command to a service with state, and bring it to where it runs."""
    call = make_call(service="counter")
    start(policy, call)
    policy.on_store_reply(1, call, stored, 0.1)
    if stored is not None:
        policy.on_reply(1, SandboxReply(True, 0.1), 0.2)
    return call


def test_a_reply_is_sent_only_after_the_state_that_belongs_to_it_is_stored():
    policy = make_policy()
    call, reply = run_counter(policy, b"1"), SandboxReply("done", 1.0, b"2")

    assert policy.on_reply(1, reply, 1.0) == [SaveSnapshot(1, call, b"1", b"2")]
    assert policy.on_store_reply(1, call, None, 1.1) == [AnswerCall(call, reply)]


def test_the_next_snapshot_replaces_the_one_that_was_stored_last():
    policy = make_policy()
    call, second = run_counter(policy, b"1"), make_call(service="counter", payload="2")
    policy.on_reply(1, SandboxReply("done", 1.0, b"2"), 1.0)
    policy.on_store_reply(1, call, None, 1.1)
    policy.submit(second, 2.0)

    actions = policy.on_reply(1, SandboxReply("done", 1.0, b"3"), 2.1)

    assert actions == [SaveSnapshot(1, second, b"2", b"3")]


def test_state_that_did_not_change_is_not_stored_again():
    policy = make_policy()
    call, reply = run_counter(policy, b"1"), SandboxReply("done", 1.0, b"1")

    assert policy.on_reply(1, reply, 1.0) == [AnswerCall(call, reply)]


def test_a_store_that_fails_is_answered_as_such_and_the_sandbox_goes_on():
    policy = make_policy()
    call = run_counter(policy)
    policy.on_reply(1, SandboxReply("done", 1.0, b"2"), 1.0)

    assert outcomes(policy.on_store_reply(1, call, StoreError("503"), 1.1)) == [(call, "store")]
    assert policy.submit(make_call(service="counter", payload="2"), 1.2) == [SendMessage(1, b"2")]


def test_a_restore_that_failed_is_repeated_before_the_next_command():
    policy, call = make_policy(), make_call(service="counter")
    start(policy, call)
    policy.on_store_reply(1, call, b"7", 0.1)
    assert outcomes(policy.on_reply(1, BadRequest("not a count"), 0.2)) == [(call, "bad-request")]

    second = make_call(service="counter", payload="2")

    assert policy.submit(second, 1.0) == [LoadSnapshot(1, second)]


def test_the_time_that_a_sandbox_works_counts_for_its_tenant_whatever_comes_of_it():
    policy = make_policy()
    number = start(policy, make_call())
    policy.on_reply(number, SandboxReply("y", 0.0), 2.0)
    assert policy.worked_s == {"acme": 2.0}
    policy.submit(make_call(now=10.0), 10.0)
    policy.on_reply(number, BadRequest("no"), 13.0)
    assert policy.worked_s == {"acme": 5.0}
    policy.submit(make_call(now=20.0), 20.0)
    policy.tick(40.0)
    policy.on_exit(number, "killed", 41.0)

    assert policy.worked_s == {"acme": 26.0}, "until it was killed for its deadline"


def test_the_time_that_a_store_takes_is_nobodys():
    policy = make_policy()
    number = start(policy, make_call(service="counter"))
    call = next(iter(policy._sandboxes.values())).running
    assert call is not None
    policy.on_store_reply(number, call, None, 5.0)
    policy.on_reply(number, SandboxReply("y", 0.0, b"state"), 6.0)
    policy.on_store_reply(number, call, None, 9.0)

    assert policy.worked_s == {"acme": 1.0}
