"""The owner of one live map: the only process that changes it, while it holds the lease.

A keyframe is judged, logged, applied and then acknowledged; what arrives during a write shares the next
entry.  Its links are measured afterwards and enter the log as events, too.  Nothing is applied before it is
durable, and nothing is told unless the lease was renewed within ``live.lease_s``: who is paused for longer,
or finds another's entry in the log, says nothing more and ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections import deque
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any

from rse_pf.backend.live_map.owner import requests
from rse_pf.backend.live_map.owner.lease import OwnerLease
from rse_pf.backend.live_map.owner.log import LiveLog, MapSnapshot, OwnershipLost
from rse_pf.backend.live_map.owner.publish import publish_version, version_to_start_from
from rse_pf.backend.live_map.owner.replies import relocalise_reply, show_reply, version_reply
from rse_pf.backend.live_map.owner.state import Applied, MapKind, MapState
from rse_pf.backend.live_map.owner.threads import Threads, Urgency
from rse_pf.backend.live_map.owner.updates import UpdateBook
from rse_pf.backend.log import JsonLog
from rse_pf.config import LiveSettings
from rse_pf.errors import (
    Busy,
    Conflict,
    InternalError,
    NotFound,
    RsePfError,
    StoreError,
    UnknownService,
)
from rse_pf.identity import RobotId
from rse_pf.live_map.events import (
    Event,
    KeyframeAdded,
    RobotForgotten,
    RobotLeft,
    encode_events,
)
from rse_pf.live_map.outcomes import (
    Added,
    Ambiguous,
    Corrected,
    Joined,
    LinkRemoved,
    OptimiseWanted,
    Outcome,
    Unaligned,
)
from rse_pf.maps.registry import MapRecord, MapRegistry

__all__ = ["LiveOwner", "OwnerContext"]

_MAX_ENTRY_EVENTS, _MAX_ENTRY_BYTES = 64, 4 << 20
_MAX_WAITING_EVENTS = 1024
_FIRST_RETRY_S, _LAST_RETRY_S = 0.05, 1.0
_SLOW_STORE_S = 1.0
"""A write that takes longer is told to the robots."""
_SETTLED_S = 5.0
"""An owner that served for this long did not die of its map."""
_BUSY_RETRY_MS = 200.0
_WAITING = "waiting for the store"
_ALIGNING = (Joined, Corrected, Unaligned, Ambiguous, LinkRemoved)


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnerContext:
    """What surrounds an owner: the map's name, time, threads, registry and listeners.

    Attributes:
        clock: Seconds, monotonic.
        wall_clock: Unix seconds.
        sleep: Waits for seconds.
        tell: Gets each new payload.
        on_beat: Gets the number of each renewal of the lease.
    """

    map_name: str
    settings: LiveSettings
    kind: MapKind
    threads: Threads
    maps: MapRegistry
    clock: Callable[[], float]
    wall_clock: Callable[[], float]
    sleep: Callable[[float], Coroutine[Any, Any, None]]
    log: JsonLog
    tell: Callable[[dict[str, Any]], None]
    on_beat: Callable[[int], None]


@dataclass(slots=True, eq=False)
class _Waiting:
    event: Event
    size: int
    done: asyncio.Future[list[Outcome]]


class LiveOwner:
    """Serves one map; its methods are called in the event loop."""

    def __init__(self, context: OwnerContext, state: MapState, log: LiveLog, lease: OwnerLease) -> None:
        """Serve nothing until `run`.

        Args:
            context: What surrounds it.
            state: The map, taken over.
            log: Its log.
            lease: Its lease, claimed.
        """
        self._context = context
        self._state = state
        self._log = log
        self._lease = lease
        self._names: dict[str, str] = {}
        self._book = UpdateBook(self._name_of)
        self._queue: deque[_Waiting] = deque()
        self._queued = asyncio.Event()
        self._adding: dict[tuple[str, int], asyncio.Task[None]] = {}
        self._outstanding: set[asyncio.Future[list[Outcome]]] = set()
        self._measurable = deque(state.unmeasured)
        self._measuring = asyncio.Event()
        self._optimise_wanted = False
        self._present: dict[str, None] = {}
        self._renewed = asyncio.Event()
        self._wrote_snapshot = 0
        self._published = 0
        self._publish_due_s = context.clock() + (context.settings.publish_s or float("inf"))
        self._last_record: MapRecord | None = None
        self._untold = False
        self._is_waiting_for_store = self._is_closing = False
        self._idle_since_s = self._began_s = context.clock()
        self.users = 0
        """Connections; kept by the server."""
        self._ended: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def is_over(self) -> bool:
        """Whether the map is no longer this owner's, or is being given up."""
        return self._ended.done() or self._is_closing

    def present(self) -> list[dict[str, Any]]:
        """Return what a new reader is told; nothing while the lease may be another's."""
        return self._book.present() if self._is_owner() else []

    async def run(self) -> str:
        """Serve until the map is lost, released or stopped; return which."""
        alignments = await self._context.threads.compute(Urgency.APPLY, self._state.live_map.alignments)
        self._book.align(alignments, (), self._state.position)
        self._describe()
        self._measuring.set()
        for work in (self._write_on(), self._measure_on(), self._keep_lease()):
            self._start(work)
        try:
            return await asyncio.shield(self._ended)
        finally:
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
            for future in list(self._outstanding):
                if not future.done():
                    future.set_exception(self._moving())

    async def answer(self, robot: RobotId, operation: str, payload: dict[str, Any]) -> dict[str, Any]:
        """Do what a robot or an operator asks for.

        Raises:
            Busy: The map moves to another owner.
            RsePfError: The request is refused.
        """
        if self.is_over:
            raise self._moving()
        self._names[robot.folder] = robot.name
        reply = await self._reply_to(robot, operation, payload)
        while (
            operation != requests.STOP and not self._is_owner()
        ):  # paused, or cut off from the store: the map may be another's
            if self._ended.done():
                raise self._moving()
            self._renewed.clear()
            await self._renewed.wait()
        return reply

    async def release(self) -> None:
        """Write what waits and a snapshot, and let any server take the map at once."""
        await self._close(self._lease.release, "released")

    # --- requests -----------------------------------------------------------------------------------

    async def _reply_to(self, robot: RobotId, operation: str, payload: dict[str, Any]) -> dict[str, Any]:
        match operation:
            case requests.KEYFRAME:
                return await self._take_keyframe(robot, payload)
            case requests.RELOCALISE:
                return await self._relocalise(payload)
            case requests.LEAVE:
                return await self._leave(robot)
            case requests.SHOW:
                return await self._context.threads.compute(
                    Urgency.ANSWER, functools.partial(self._shown, robot)
                )
            case requests.PUBLISH:
                return version_reply(self._context.map_name, await self._publish(f"published by {robot}"))
            case requests.STOP:
                return await self._stop()
            case requests.FORGET:
                return await self._forget(requests.to_request(payload, requests.ForgetRequest))
            case requests.START:
                return await self._start_from(requests.to_request(payload, requests.StartRequest))
        raise UnknownService(f"no operation {operation[:80]!r} of live maps", hint="see docs/protocol.md")

    async def _take_keyframe(self, robot: RobotId, payload: dict[str, Any]) -> dict[str, Any]:
        event = requests.keyframe_event(robot, payload)
        key = event.robot, event.number
        adding = self._adding.get(key)  # the robot has sent it twice
        if adding is None:
            self._present[event.robot] = None
            adding = self._adding[key] = asyncio.ensure_future(self._add(event))
            adding.add_done_callback(lambda _: self._adding.pop(key))
        await asyncio.shield(adding)
        return {"number": event.number + 1, "version": self._state.position}

    async def _add(self, event: KeyframeAdded) -> None:
        """Return when a keyframe is durable; those before it that are on their way come first."""
        compute, live_map = self._context.threads.compute, self._state.live_map
        while True:
            verdict = await compute(Urgency.JUDGE, functools.partial(live_map.judge, event))
            if verdict == "known":
                return
            if verdict == "new":
                await asyncio.shield(self._submit(event, len(event.features)))
                return
            before = self._adding.get((event.robot, event.number - 1))
            if before is not None:
                await asyncio.wait({before})
                continue
            expected = await compute(Urgency.JUDGE, functools.partial(live_map.next_number, event.robot))
            if event.number > expected:
                raise Conflict(
                    f"keyframe {event.number} arrived, but {expected} is the next one",
                    hint=f"send keyframe {expected} first",
                )

    async def _relocalise(self, payload: dict[str, Any]) -> dict[str, Any]:
        request = requests.to_request(payload, requests.RelocaliseRequest)
        camera = requests.camera_of(request.camera)
        found = await self._context.threads.compute(
            Urgency.ANSWER, lambda: self._state.live_map.relocalise(camera, request.features)
        )
        return relocalise_reply(found, self._state.position)

    async def _leave(self, robot: RobotId) -> dict[str, Any]:
        if robot.folder in await self._context.threads.compute(
            Urgency.ANSWER, lambda: self._state.live_map.robots
        ):
            await asyncio.shield(self._submit(RobotLeft(robot=robot.folder)))
        self._present.pop(robot.folder, None)
        if not self._present:
            self._start(self._publish_quietly("the last robot left"))
        return {}

    async def _forget(self, request: requests.ForgetRequest) -> dict[str, Any]:
        known = await self._context.threads.compute(
            Urgency.ANSWER, lambda: list(self._state.live_map.contributors)
        )
        folders = [folder for folder in known if self._names.get(folder) == request.robot]
        folders += [each for each in requests.folders_of(request.robot, known) if each not in folders]
        if not folders:
            raise NotFound(
                f"robot {request.robot[:80]!r} contributed nothing", hint="see rse-pf map live show MAP"
            )
        for folder in folders:
            await asyncio.shield(self._submit(RobotForgotten(robot=folder)))
        return {"forgotten": len(folders), "version": self._state.position}

    async def _start_from(self, request: requests.StartRequest) -> dict[str, Any]:
        if self._state.changes or self._state.keyframes:
            raise Conflict(
                f"the live map {self._context.map_name!r} has begun already",
                hint=f"stop it first: rse-pf map live stop {self._context.map_name}",
            )
        if request.source:
            version, source = await self._context.threads.background(
                lambda: version_to_start_from(self._context.maps, self._context.map_name, request.source)
            )
            event = await self._context.threads.background(
                lambda: self._context.kind.started_from(version, source)
            )
            await asyncio.shield(self._submit(event))
        return {"keyframes": self._state.keyframes, "version": self._state.position}

    async def _stop(self) -> dict[str, Any]:
        record = await self._publish("the live map was stopped") if self._state.keyframes else None
        await self._close(lambda: self._lease.stop(self._log.position), "stopped")
        with contextlib.suppress(StoreError):  # what is left is ignored, and deleted by the next owner
            await self._context.threads.background(
                functools.partial(self._log.delete_until, self._lease.record.base)
            )
        return {} if record is None else version_reply(self._context.map_name, record)

    def _shown(self, robot: RobotId) -> dict[str, Any]:
        """Return what *robot* sees of the map; in the thread of the map."""
        return show_reply(
            robot,
            self._state,
            self._lease.record,
            told_state=self._told_state(),
            name_of=self._name_of,
            is_present=self._present.__contains__,
        )

    # --- the log ------------------------------------------------------------------------------------

    def _submit(self, event: Event, size: int = 0) -> asyncio.Future[list[Outcome]]:
        """Let *event* enter the log; the future holds its outcomes when it is durable and applied."""
        if len(self._queue) >= _MAX_WAITING_EVENTS and isinstance(event, KeyframeAdded):
            raise Busy("the live map cannot store more now", hint="wait", retry_after_ms=_BUSY_RETRY_MS)
        waiting = _Waiting(event, size, asyncio.get_running_loop().create_future())
        waiting.done.add_done_callback(lambda done: done.cancelled() or done.exception())
        self._outstanding.add(waiting.done)
        waiting.done.add_done_callback(self._outstanding.discard)
        self._queue.append(waiting)
        self._queued.set()
        return waiting.done

    async def _write_on(self) -> None:
        while True:
            await self._queued.wait()
            batch = self._next_batch()
            if not self._queue:
                self._queued.clear()
            events = [each.event for each in batch]
            position = await self._make_durable(encode_events(events))
            applied = await self._context.threads.compute(
                Urgency.APPLY, functools.partial(self._apply, position, events)
            )
            self._take_applied(batch, *applied)

    def _apply(self, position: int, events: list[Event]) -> tuple[Applied, list[dict[str, Any]]]:
        """Apply an entry and note what to tell; in the thread of the map."""
        applied = self._state.apply(position, events)
        outcomes = [each for found in applied.outcomes for each in found]
        told: list[dict[str, Any]] = []
        keyframes = [event for event in events if isinstance(event, KeyframeAdded)]
        if (
            any(isinstance(each, _ALIGNING) for each in outcomes)
            or any(isinstance(event, RobotForgotten) for event in events)
            or not all(map(self._book.knows_segment, keyframes))
        ):
            told += self._book.align(self._state.live_map.alignments(), outcomes, position)
        for event in keyframes:
            told += self._book.place(event)
        return applied, told

    def _take_applied(self, batch: list[_Waiting], applied: Applied, told: list[dict[str, Any]]) -> None:
        for each, outcomes, defect in zip(batch, applied.outcomes, applied.defects, strict=True):
            if defect is not None:
                self._context.log.error("live-map-defect", map=self._context.map_name, error=repr(defect))
                each.done.set_exception(InternalError("the map failed on this event", hint="report it"))
            elif not each.done.done():
                each.done.set_result(outcomes)
            self._optimise_wanted |= any(isinstance(outcome, OptimiseWanted) for outcome in outcomes)
            if isinstance(each.event, KeyframeAdded):
                self._measurable += [outcome.id for outcome in outcomes if isinstance(outcome, Added)]
        self._measuring.set()
        for payload in told:
            self._tell(payload)
        if applied.snapshot is not None:
            self._start(self._write_snapshot(applied.snapshot))

    def _next_batch(self) -> list[_Waiting]:
        batch = [self._queue.popleft()]
        size = batch[0].size
        while self._queue and len(batch) < _MAX_ENTRY_EVENTS:
            size += self._queue[0].size
            if size > _MAX_ENTRY_BYTES:
                break
            batch.append(self._queue.popleft())
        return batch

    async def _make_durable(self, data: bytes) -> int:
        """Write the next entry, however long the store fails; the same bytes each time."""
        wait_s = _FIRST_RETRY_S
        while True:
            write = asyncio.ensure_future(self._context.threads.store(lambda: self._log.write(data)))
            try:
                await asyncio.wait({write}, timeout=_SLOW_STORE_S)
                self._note_store(is_waiting=not write.done())
                position = await write
            except OwnershipLost as error:
                self._lose(error.message)
                await asyncio.Event().wait()
            except StoreError as error:
                self._context.log.warning("live-log-retry", map=self._context.map_name, error=error.message)
                self._note_store(is_waiting=wait_s > _FIRST_RETRY_S)
                await self._context.sleep(wait_s)
                wait_s = min(_LAST_RETRY_S, 2 * wait_s)
            else:
                self._note_store(is_waiting=False)
                return position

    async def _write_snapshot(self, snapshot: MapSnapshot) -> None:
        try:
            await self._context.threads.background(lambda: self._log.write_snapshot(snapshot))
        except StoreError as error:  # the next one is written later; a restart only takes longer
            self._context.log.warning("live-snapshot-failed", map=self._context.map_name, error=error.message)
        else:
            self._wrote_snapshot = snapshot.position

    # --- background work ----------------------------------------------------------------------------

    async def _measure_on(self) -> None:
        compute, state = self._context.threads.compute, self._state
        while True:
            await self._measuring.wait()
            if self._measurable:
                keyframe = self._measurable.popleft()
                self._submit(await compute(Urgency.MEASURE, functools.partial(state.measure, keyframe)))
            elif self._optimise_wanted:
                self._optimise_wanted = False
                with contextlib.suppress(RsePfError):
                    self._submit(await compute(Urgency.BACKGROUND, state.live_map.optimise))
            else:
                self._measuring.clear()

    async def _publish(self, note: str) -> MapRecord:
        """Publish the map unless its newest version was published already.

        Raises:
            NotFound: The map is empty.
        """
        changes = self._state.changes
        if self._last_record is not None and changes == self._published:
            return self._last_record
        if not self._state.keyframes:
            raise NotFound(f"the live map {self._context.map_name!r} is empty", hint="drive a robot first")
        context = self._context
        version = await context.threads.compute(Urgency.BACKGROUND, self._state.live_map.to_version)
        record = await context.threads.background(
            lambda: publish_version(
                context.maps,
                context.map_name,
                version,
                author=f"live map on {self._lease.record.server}",
                created_s=context.wall_clock(),
                note=note,
            )
        )
        self._published, self._last_record = changes, record
        context.log.info("live-map-published", map=context.map_name, id=record.id, number=record.number)
        return record

    async def _publish_quietly(self, note: str) -> None:
        try:
            if self._state.changes != self._published:
                await self._publish(note)
        except NotFound:
            pass
        except RsePfError as error:
            self._context.log.warning("live-publish-failed", map=self._context.map_name, error=error.message)

    # --- the lease ----------------------------------------------------------------------------------

    async def _keep_lease(self) -> None:
        settings, clock = self._context.settings, self._context.clock
        while not self._ended.done():
            is_settled = clock() - self._began_s >= _SETTLED_S
            wait_s = settings.heartbeat_s
            try:
                is_ours = await self._context.threads.lease(
                    functools.partial(self._lease.renew, is_settled=is_settled)
                )
            except StoreError:
                wait_s = min(wait_s, _FIRST_RETRY_S)
            else:
                if self._ended.done():
                    return
                if not is_ours:
                    self._lose("another process has taken the lease")
                    return
                self._after_renewal()
            await self._context.sleep(wait_s)

    def _after_renewal(self) -> None:
        now = self._context.clock()
        self._renewed.set()
        if self._untold:
            self._untold = False
            for payload in self._book.present():
                self._tell(payload)
        self._context.on_beat(self._lease.record.beat)
        self._describe()
        if self._is_closing:
            return
        if now >= self._publish_due_s:
            self._publish_due_s = now + self._context.settings.publish_s
            self._start(self._publish_quietly("live map"))
        if self.users:
            self._idle_since_s = now
        elif now - self._idle_since_s >= self._context.settings.idle_s:
            self._idle_since_s = now
            self._start(self._end_idle())

    async def _end_idle(self) -> None:
        await self._publish_quietly("nobody used the live map")
        if not self.users:
            await self.release()

    def _is_owner(self) -> bool:
        """Whether nobody can have taken the map over until now."""
        return not self._ended.done() and self._lease.age_s < self._context.settings.lease_s

    async def _close(self, give_up: Callable[[], bool], how: str) -> None:
        """Write what waits, then end by *give_up*, a change of the lease."""
        if self._is_closing:
            await asyncio.shield(self._ended)
            return
        self._is_closing = True
        self._describe()
        if self._outstanding:
            await asyncio.wait(set(self._outstanding))
        snapshot = await self._context.threads.compute(Urgency.APPLY, self._state.snapshot)
        if how == "released" and snapshot.position > self._wrote_snapshot:
            await self._write_snapshot(snapshot)
        wait_s = _FIRST_RETRY_S
        while not self._ended.done():
            try:
                is_ours = await self._context.threads.lease(give_up)
            except StoreError:
                await self._context.sleep(wait_s)
                wait_s = min(_LAST_RETRY_S, 2 * wait_s)
            else:
                self._end(how if is_ours else "lost")

    def _lose(self, reason: str) -> None:
        self._context.log.warning("live-map-lost", map=self._context.map_name, reason=reason)
        self._end("lost")

    def _end(self, how: str) -> None:
        if not self._ended.done():
            self._ended.set_result(how)
        self._renewed.set()

    # --- what is told -------------------------------------------------------------------------------

    def _tell(self, payload: dict[str, Any]) -> None:
        if self._is_owner():
            self._context.tell(payload)
        else:
            self._untold = True

    def _describe(self) -> None:
        state = self._told_state()
        for payload in self._book.describe(
            keyframes=self._state.keyframes, version=self._state.position,
            owner=self._lease.record.server, state=state,
        ):  # fmt: skip
            if state == _WAITING:  # without the store nobody else can own the map
                self._context.tell(payload)
            else:
                self._tell(payload)

    def _told_state(self) -> str:
        if self._is_closing:
            return "moving"
        return _WAITING if self._is_waiting_for_store else "live"

    def _note_store(self, *, is_waiting: bool) -> None:
        if is_waiting != self._is_waiting_for_store:
            self._is_waiting_for_store = is_waiting
            self._describe()

    def _name_of(self, folder: str) -> str:
        """Return the name under which the robot with this `RobotId.folder` is shown."""
        return self._names.get(folder) or requests.shown_name(folder)

    def _moving(self) -> requests.MapMoves:
        return requests.MapMoves(
            "the live map moves to another server", hint="try again", retry_after_ms=_BUSY_RETRY_MS
        )

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._on_task_end)

    def _on_task_end(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and task.exception() is not None:
            self._context.log.error(
                "live-owner-defect", map=self._context.map_name, error=repr(task.exception())
            )
            self._end("defect")
