"""Send a command to a backend server, the burst function or the robot itself, as a plan of `CloudFirst` says.

These three are called places.  A call returns the first answer that is not a failure.  After a failure that
another place may not have (`CloudFirst.can_recover`), the call waits for the other places, and asks those of
its plan that were not asked yet; only if all of them fail does it return a failure.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, Literal

from client_sdk.commands.answer_types import Answer
from client_sdk.commands.traffic_stats import TrafficCounter
from client_sdk.concurrency.tasks import cancel_tasks
from client_sdk.concurrency.user_callbacks import UserCallbacks
from client_sdk.offloading.burst_client import BurstClient
from client_sdk.offloading.local_services import LocalServices
from client_sdk.offloading.offload_policy import CloudFirst, Plan
from client_sdk.tracing import current_trace
from rse_pf.wire import Command, Failure, Result
from rse_pf.wire.client_session import Answered, ClientSession, Progressed

__all__ = ["CallArguments", "CommandRouter", "OnProgress"]

OnProgress = Callable[[float, str], None]
"""Called with the share (0..1) of a long command that is computed, and the name of the last finished step."""

PLACE_NAMES = {"server": "the cloud", "burst": "the burst function", "robot": "the robot"}
"""For each place, its name in the field ``why`` of an answer that another place gave after this place had
failed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CallArguments:
    """The arguments of one call of `Robot.call`, which explains them.

    ``deadline_s`` is always a number.  ``is_open_ended`` says that the caller gave no deadline: the servers
    then get the command without one, and a service that takes long may take longer than ``deadline_s``.
    """

    service: str
    request: Any
    deadline_s: float
    stream: str
    keep: bool
    is_open_ended: bool = False
    on_progress: OnProgress | None = None


@dataclass(frozen=True, slots=True)
class _PlannedRequest:
    """A place, and how many seconds after the call began it is asked, unless there is an answer."""

    place: Literal["server", "burst", "robot"]
    after_s: float


class CommandRouter:
    """Send commands of one robot to the backend servers, the burst function or the robot itself."""

    def __init__(
        self,
        *,
        session: ClientSession,
        flush: Callable[[], None],
        counter: TrafficCounter,
        clock: Callable[[], float],
        policy: CloudFirst | None,
        local: LocalServices | None,
        burst: BurstClient,
        callbacks: UserCallbacks,
    ) -> None:
        """Store the arguments; no command is sent yet.

        Args:
            session: Encodes commands for the servers, and holds those without an answer.
            flush: Sends the messages that *session* has encoded.
            counter: Gets the round trips to servers, and predicts the next one.
            clock: Monotonic seconds.
            policy: Plans the commands; None means `CloudFirst` with its defaults.
            local: Services of the robot itself; None if the robot never computes commands.
            burst: Client of the burst function.
            callbacks: Calls the *on_progress* of a call, and survives its exceptions.
        """
        self.waiting: dict[int, asyncio.Future[Answered] | Callable[[Answered], None]] = {}
        """For the id of each command at the servers, the future of its answer, or a function that is called
        with its answer."""
        self._session = session
        self._flush = flush
        self._counter = counter
        self._clock = clock
        self._policy = policy or CloudFirst()
        self._local = local
        self._burst = burst
        self._callbacks = callbacks
        self._on_progress: dict[int, OnProgress] = {}
        self._tasks: set[asyncio.Task[Answer | Failure]] = set()

    async def ask(self, call: CallArguments) -> Answer | Failure:
        """Plan *call*, ask the places of the plan, and return the first answer or a failure (see `_race`)."""
        local, current = self._local, self._session.current
        self.read_welcome()
        plan = self._policy.plan(
            deadline_s=call.deadline_s,
            connected=current is not None,
            expected_round_trip_s=self._counter.expected_round_trip_s(),
            robot_solve_s=None if local is None else local.solve_s,
            robot_can=local is not None and local.offers(call.service),
            burst_s=None if call.on_progress is not None else self._burst.expected_s(call.service),
        )
        requests = _planned_requests(plan)
        if [request.place for request in requests] == ["server"]:
            return await self._ask_server(call)
        return await self._race(requests, call, plan.why)

    def read_welcome(self) -> None:
        """Pass the Welcome of the connected server, if any, to the client of the burst function.

        The Welcome states the address of the burst function, which is needed when no server is connected.
        """
        current = self._session.current
        if current is not None and current.welcome is not None:
            self._burst.read_welcome(current.welcome)

    def handle_event(self, event: Answered | Progressed) -> None:
        """Deliver an answer of a server, or the progress of a long command, to the call that waits for it."""
        if isinstance(event, Progressed):
            if event.id in self._on_progress:
                self._callbacks.notify("on_progress", self._on_progress[event.id], event.done, event.what)
            return
        waiting = self.waiting.get(event.id)
        if isinstance(waiting, asyncio.Future):
            if waiting.done():
                self._counter.duplicates += not waiting.cancelled()
            else:
                waiting.set_result(event)
        elif waiting is not None:
            del self.waiting[event.id]
            self._callbacks.notify("on_end", waiting, event)
        else:
            self._counter.duplicates += 1

    async def close(self) -> None:
        """Cancel all calls that still run, and close the client of the burst function."""
        await cancel_tasks(self._tasks)
        await self._burst.close()

    async def _race(
        self, requests: deque[_PlannedRequest], call: CallArguments, why: str
    ) -> Answer | Failure:
        """Ask each place at its planned time, or earlier if no other is working; return the first answer.

        A failure that other places would have, too (not `CloudFirst.can_recover`), and any failure of the
        robot itself are returned at once.  If all places fail, the failure that arrived first is returned.
        At the deadline the failure ``expired`` is returned.
        """
        began_s = self._clock()
        running: dict[asyncio.Task[Answer | Failure], _PlannedRequest] = {}
        message = "neither the cloud nor the robot answered in time"
        expired = Failure(code="expired", message=message, hint="set a longer deadline_s")
        first_failure: Failure | None = None
        try:
            while requests or running:
                # 1. Give up at the deadline.
                elapsed_s = self._clock() - began_s
                if elapsed_s >= call.deadline_s:
                    return expired
                # 2. Ask the places whose time has come, or the next one if no place is working.
                while requests and (requests[0].after_s <= elapsed_s or not running):
                    request = requests.popleft()
                    left_s = call.deadline_s - elapsed_s
                    if self._can_be_in_time(request, call, left_s):
                        running[self._start_task(self._ask_place(request, call, left_s, why))] = request
                if not running:
                    continue
                # 3. Wait for an answer, or for the time of the next place.
                until_s = requests[0].after_s if requests else call.deadline_s
                done, _ = await asyncio.wait(
                    running, timeout=max(0.0, until_s - elapsed_s), return_when=asyncio.FIRST_COMPLETED
                )
                # 4. Return an answer or a final failure; if several have arrived, that of a server is
                #    preferred.
                for task in sorted(done, key=lambda task: running[task].place != "server"):
                    request, answer = running.pop(task), task.result()
                    if request.place == "robot" or isinstance(answer, Answer):
                        return answer
                    if not self._policy.can_recover(answer.code):
                        return answer
                    why = f"{PLACE_NAMES[request.place]} answered {answer.code}"
                    first_failure = first_failure or answer
            return first_failure or expired
        except asyncio.CancelledError:
            for task in running:
                task.cancel()
            raise
        finally:
            # The requests that have no answer yet are not cancelled, because their times are measured.  Only
            # a command that waits for a connection to a server is cancelled, so that it is not sent later.
            for task, request in running.items():
                if request.place == "server" and self._session.current is None:
                    task.cancel()

    def _can_be_in_time(self, request: _PlannedRequest, call: CallArguments, left_s: float) -> bool:
        if request.place != "burst":
            return True
        expected_s = self._burst.expected_s(call.service)
        return expected_s is not None and expected_s < left_s

    def _ask_place(
        self, request: _PlannedRequest, call: CallArguments, left_s: float, why: str
    ) -> Coroutine[Any, Any, Answer | Failure]:
        if request.place == "server":
            return self._ask_server(call)
        if request.place == "burst":
            return self._ask_burst(call, left_s, why)
        assert self._local is not None
        return self._ask_robot(self._local, call, why)

    async def _ask_server(self, call: CallArguments) -> Answer | Failure:
        identity = self._session.submit(
            call.service,
            call.request,
            now=self._clock(),
            stream=call.stream,
            keep=call.keep,
            deadline_s=None if call.is_open_ended else call.deadline_s,
            is_open_ended=call.on_progress is not None,
            trace=current_trace(),
        )
        future: asyncio.Future[Answered] = asyncio.get_running_loop().create_future()
        self.waiting[identity] = future
        if call.on_progress is not None:
            self._on_progress[identity] = call.on_progress
        self._flush()
        try:
            answered = await future
        finally:
            self._on_progress.pop(identity, None)
            self.waiting.pop(identity, None)
            self._session.cancel(identity)
            self._flush()
        round_trip_s = self._clock() - answered.sent_s
        answer = answered.answer
        if isinstance(answer, Result) or answer.code == "expired":
            self._counter.add_round_trip(round_trip_s)
        return _server_answer(answered, answer, round_trip_s) if isinstance(answer, Result) else answer

    async def _ask_burst(self, call: CallArguments, left_s: float, why: str) -> Answer | Failure:
        command = Command(
            id=1,
            service=call.service,
            payload=call.request,
            stream=call.stream,
            keep=call.keep,
            deadline_ms=left_s * 1e3,
            trace=current_trace(),
        )
        return await self._burst.ask(command, deadline_s=left_s, why=why)

    async def _ask_robot(self, local: LocalServices, call: CallArguments, why: str) -> Answer | Failure:
        began_s = self._clock()
        result = await local.ask(Command(id=0, service=call.service, payload=call.request))
        if isinstance(result, Failure):
            return result
        return Answer(
            reply=result.reply,
            source="robot",
            server=result.server,
            round_trip_ms=(self._clock() - began_s) * 1e3,
            queue_ms=0.0,
            compute_ms=result.compute_ms,
            why=why,
        )

    def _start_task(self, work: Coroutine[Any, Any, Answer | Failure]) -> asyncio.Task[Answer | Failure]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task


def _planned_requests(plan: Plan) -> deque[_PlannedRequest]:
    """Return the places of *plan* in the order of their times; the burst function before the robot."""
    requests = [] if plan.where == "robot" else [_PlannedRequest("server", 0.0)]
    if plan.burst_after_s is not None:
        requests.append(_PlannedRequest("burst", plan.burst_after_s))
    if plan.where != "cloud":
        requests.append(_PlannedRequest("robot", plan.robot_after_s))
    return deque(sorted(requests, key=lambda request: request.after_s))


def _server_answer(answered: Answered, result: Result, round_trip_s: float) -> Answer:
    up_ms, down_ms = (None if s is None else s * 1e3 for s in (answered.up_s, answered.down_s))
    return Answer(
        reply=result.reply,
        source="cloud",
        server=result.server,
        round_trip_ms=round_trip_s * 1e3,
        queue_ms=result.queue_ms,
        compute_ms=result.compute_ms,
        up_ms=up_ms,
        down_ms=down_ms,
        payload_bytes=answered.wire_bytes,
        object=result.object,
    )
