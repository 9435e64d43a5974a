"""Ask for one command: a server, the burst function and the robot itself, as a plan of `CloudFirst` says.

A call ends with the first good answer.  No place is asked once it cannot be in time, and a failure that
another place may not share is passed on only if no other place is left.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, Literal

from client_sdk.commands.answer_types import Answer
from client_sdk.commands.traffic_stats import StatsKeeper
from client_sdk.concurrency.user_callbacks import Callbacks
from client_sdk.network.region_sockets import cancel_all
from client_sdk.offloading.burst_client import Burst
from client_sdk.offloading.local_services import LocalServices
from client_sdk.offloading.offload_policy import CloudFirst, Plan
from client_sdk.tracing import current_trace
from rse_pf.wire import Command, Failure, Result
from rse_pf.wire.client_session import Answered, ClientSession, Progressed

__all__ = ["Asking", "Call", "OnProgress"]

OnProgress = Callable[[float, str], None]
"""Called with the share of a long command that is done (0..1), and what was done last."""

Ended = Answer | Failure
_SHOWN = {"server": "the cloud", "burst": "the burst function", "robot": "the robot"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Call:
    """The arguments of one call."""

    service: str
    request: Any
    deadline_s: float
    stream: str
    keep: bool
    is_open_ended: bool = False
    on_progress: OnProgress | None = None


@dataclass(frozen=True, slots=True)
class _Turn:
    place: Literal["server", "burst", "robot"]
    after_s: float


class Asking:
    """The three places that may answer a robot's commands, and the commands that wait for a server."""

    def __init__(
        self,
        *,
        session: ClientSession,
        flush: Callable[[], None],
        keeper: StatsKeeper,
        clock: Callable[[], float],
        offload: CloudFirst | None,
        local: LocalServices | None,
        burst: Burst,
        callbacks: Callbacks,
    ) -> None:
        self.waiting: dict[int, asyncio.Future[Answered] | Callable[[Answered], None]] = {}
        self._session = session
        self._flush = flush
        self._keeper = keeper
        self._clock = clock
        self._offload = offload or CloudFirst()
        self._local = local
        self._burst = burst
        self._callbacks = callbacks
        self._on_progress: dict[int, OnProgress] = {}
        self._tasks: set[asyncio.Task[Ended]] = set()

    async def ask(self, call: Call) -> Ended:
        """Return the answer of the first place that has one, or the failure."""
        local, current = self._local, self._session.current
        self.hear_welcome()
        plan = self._offload.plan(
            deadline_s=call.deadline_s,
            connected=current is not None,
            expected_round_trip_s=self._keeper.expected_round_trip_s(),
            robot_solve_s=None if local is None else local.solve_s,
            robot_can=local is not None and local.offers(call.service),
            burst_s=None if call.on_progress is not None else self._burst.expected_s(call.service),
        )
        turns = _turns(plan)
        if [turn.place for turn in turns] == ["server"]:
            return await self._ask_server(call)
        return await self._race(turns, call, plan.why)

    def hear_welcome(self) -> None:
        """Remember what the present server says of the burst function, for when there is none."""
        current = self._session.current
        if current is not None and current.welcome is not None:
            self._burst.heard(current.welcome)

    def answered(self, event: Answered | Progressed) -> None:
        """Hand an event of the session to whom it concerns."""
        if isinstance(event, Progressed):
            if event.id in self._on_progress:
                self._callbacks.notify("on_progress", self._on_progress[event.id], event.done, event.what)
            return
        waiting = self.waiting.get(event.id)
        if isinstance(waiting, asyncio.Future):
            if waiting.done():
                self._keeper.duplicates += not waiting.cancelled()
            else:
                waiting.set_result(event)
        elif waiting is not None:
            del self.waiting[event.id]
            self._callbacks.notify("on_end", waiting, event)
        else:
            self._keeper.duplicates += 1

    async def close(self) -> None:
        """End what still runs."""
        await cancel_all(self._tasks)
        await self._burst.close()

    async def _race(self, turns: deque[_Turn], call: Call, why: str) -> Ended:
        """Ask each place in its turn, or as soon as nobody else is asked; return the first good answer."""
        began = self._clock()
        racing: dict[asyncio.Task[Ended], _Turn] = {}
        message = "neither the cloud nor the robot answered in time"
        failure = Failure(code="expired", message=message, hint="set a longer deadline_s")
        first: Failure | None = None
        try:
            while turns or racing:
                past_s = self._clock() - began
                if past_s >= call.deadline_s:
                    return failure
                while turns and (turns[0].after_s <= past_s or not racing):
                    turn = turns.popleft()
                    left_s = call.deadline_s - past_s
                    if self._can_be_in_time(turn, call, left_s):
                        racing[self._spawn(self._ask_place(turn, call, left_s, why))] = turn
                if not racing:
                    continue
                until_s = turns[0].after_s if turns else call.deadline_s
                done, _ = await asyncio.wait(
                    racing, timeout=max(0.0, until_s - past_s), return_when=asyncio.FIRST_COMPLETED
                )
                for task in sorted(done, key=lambda task: racing[task].place != "server"):
                    turn, ended = racing.pop(task), task.result()
                    if turn.place == "robot" or isinstance(ended, Answer):
                        return ended
                    if not self._offload.can_recover(ended.code):
                        return ended
                    why = f"{_SHOWN[turn.place]} answered {ended.code}"
                    first = first or ended
            return first or failure
        except asyncio.CancelledError:
            for task in racing:
                task.cancel()
            raise
        finally:
            # Late answers still count as measured; but what waits for a server is not sent later.
            for task, turn in racing.items():
                if turn.place == "server" and self._session.current is None:
                    task.cancel()

    def _can_be_in_time(self, turn: _Turn, call: Call, left_s: float) -> bool:
        if turn.place != "burst":
            return True
        expected_s = self._burst.expected_s(call.service)
        return expected_s is not None and expected_s < left_s

    def _ask_place(self, turn: _Turn, call: Call, left_s: float, why: str) -> Coroutine[Any, Any, Ended]:
        if turn.place == "server":
            return self._ask_server(call)
        if turn.place == "burst":
            return self._ask_burst(call, left_s, why)
        assert self._local is not None
        return self._ask_robot(self._local, call, why)

    async def _ask_server(self, call: Call) -> Ended:
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
            ended = await future
        finally:
            self._on_progress.pop(identity, None)
            self.waiting.pop(identity, None)
            self._session.cancel(identity)
            self._flush()
        round_trip_s = self._clock() - ended.sent_s
        answer = ended.answer
        if isinstance(answer, Result) or answer.code == "expired":
            self._keeper.add_round_trip(round_trip_s)
        return _from_server(ended, answer, round_trip_s) if isinstance(answer, Result) else answer

    async def _ask_burst(self, call: Call, left_s: float, why: str) -> Ended:
        command = Command(
            id=1, service=call.service, payload=call.request, stream=call.stream, keep=call.keep,
            deadline_ms=left_s * 1e3, trace=current_trace(),
        )  # fmt: skip
        return await self._burst.ask(command, deadline_s=left_s, why=why)

    async def _ask_robot(self, local: LocalServices, call: Call, why: str) -> Ended:
        started = self._clock()
        ended = await local.ask(Command(id=0, service=call.service, payload=call.request))
        if isinstance(ended, Failure):
            return ended
        return Answer(
            reply=ended.reply,
            source="robot",
            server=ended.server,
            round_trip_ms=(self._clock() - started) * 1e3,
            queue_ms=0.0,
            compute_ms=ended.compute_ms,
            why=why,
        )

    def _spawn(self, work: Coroutine[Any, Any, Ended]) -> asyncio.Task[Ended]:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task


def _turns(plan: Plan) -> deque[_Turn]:
    """Return who is asked, in the order of time; the burst function comes before the robot."""
    turns = [] if plan.where == "robot" else [_Turn("server", 0.0)]
    if plan.burst_after_s is not None:
        turns.append(_Turn("burst", plan.burst_after_s))
    if plan.where != "cloud":
        turns.append(_Turn("robot", plan.robot_after_s))
    return deque(sorted(turns, key=lambda turn: turn.after_s))


def _from_server(ended: Answered, result: Result, round_trip_s: float) -> Answer:
    up_ms, down_ms = (None if s is None else s * 1e3 for s in (ended.up_s, ended.down_s))
    return Answer(
        reply=result.reply,
        source="cloud",
        server=result.server,
        round_trip_ms=round_trip_s * 1e3,
        queue_ms=result.queue_ms,
        compute_ms=result.compute_ms,
        up_ms=up_ms,
        down_ms=down_ms,
        payload_bytes=ended.wire_bytes,
        object=result.object,
    )
