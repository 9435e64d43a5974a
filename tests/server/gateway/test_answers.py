"""What an answer says besides the reply: how long its command waited, and what else the server offers."""

from __future__ import annotations

import pytest

from rse_pf.auth.tokens import Claims
from rse_pf.server.scheduling.command_queue import QueuedCommand
from rse_pf.wire import Command, Failure, Result
from tests.kit.worker_parts import worker_parts


def test_the_time_that_a_job_waited_is_not_the_servers_clock() -> None:
    with worker_parts() as worker:
        connection, wire = worker.join()
        command = Command(id=7, service="merge", payload={})
        received_s = worker.loop.now
        queued = QueuedCommand(connection, connection.robot, command, 9, received_s, 1e9)
        worker.loop.now += 5.0

        worker.answers.send_message(queued, Result(id=7, reply={}, compute_ms=3000.0))

        (result,) = [each for each in wire.sent if isinstance(each, Result)]
        assert result.queue_ms == pytest.approx(2000.0)


@pytest.mark.parametrize(
    ("scopes", "offered"),
    [
        ((), "echo, centroid, secret-survey"),
        (("services:*",), "echo, centroid, secret-survey"),
        (("services:centriod", "services:centroid"), "centroid"),
        (("services:centriod",), "none to you"),
    ],
)
def test_an_unknown_service_is_answered_with_what_the_token_allows_and_nothing_else(
    scopes: tuple[str, ...], offered: str
) -> None:
    with worker_parts() as worker:
        worker.registry.others = ("centroid", "secret-survey")
        connection, wire = worker.join()
        connection.claims = Claims(
            robot=connection.robot, token_id="t", issued_s=0.0, expires_s=1e12, key_id="k", scopes=scopes
        )

        worker.say(connection, Command(id=3, service="centriod", payload={}))

        assert wire.sent[-1].code == "unknown-service"
        assert wire.sent[-1].message == f"no service named 'centriod'; this server offers {offered}"


def test_the_time_of_a_command_counts_for_its_tenant_whether_it_succeeds_or_fails() -> None:
    with worker_parts() as worker:
        connection, _ = worker.join()
        now = worker.loop.now
        for identity, started_s, message in (
            (1, now, Result(id=1, reply={}, compute_ms=250.0)),
            (2, now - 0.5, Failure(id=2, code="no-consensus", message="m")),
            (3, 0.0, Failure(id=3, code="busy", message="refused before it began")),
        ):
            command = Command(id=identity, service="echo", payload={})
            queued = QueuedCommand(connection, connection.robot, command, 9, now - 1.0, 1e9)
            queued.started_s = started_s
            worker.answers.send(worker.answers._encode(queued, message), now)
            worker.answers.send_message(queued, message)  # what computed it counts by itself

        taken = worker.dispatcher.snapshot()["tenant_cpu_s"]
        assert taken == [[connection.robot.tenant, "commands", pytest.approx(0.75)]]
