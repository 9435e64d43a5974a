"""The owner of one live map: the only process that changes it, while it holds the lease.

A keyframe is judged, logged, applied and then acknowledged.  Its links are measured afterwards, while the map
goes on, and enter the log as events, too.  Nothing is applied before it is
durable, and nothing is told unless the lease was renewed within ``live.lease_s``: who is paused for longer,
or finds another's entry in the log, says nothing more and ends.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections.abc import Callable, Coroutine, Iterable
from typing import Any

import msgspec

from rse_pf.config import LiveSettings
from rse_pf.errors import (
    BadRequest,
    Busy,
    Conflict,
    InternalError,
    NotFound,
    StoreError,
    StoreFull,
    UnknownService,
    message_of,
)
from rse_pf.identity import RobotId, folders_of, shown_name
from rse_pf.live_map.events import Event, KeyframeAdded, MapStarted, RobotForgotten, RobotLeft
from rse_pf.live_map.outcomes import (
    Added,
    Ambiguous,
    Corrected,
    Culled,
    Joined,
    LoopClosureRejected,
    OptimiseWanted,
    Outcome,
    Unaligned,
)
from rse_pf.server.live_map.owner.context import OwnerContext
from rse_pf.server.live_map.owner.lease import OwnerLease, renewal_s
from rse_pf.server.live_map.owner.log import (
    BUSY_RETRY_MS,
    SLOW_STORE_S,
    EntryWriter,
    LiveLog,
    MapSnapshot,
    Submitted,
)
from rse_pf.server.live_map.owner.publisher import AUTOMATIC_NOTES, Publisher, version_to_start_from
from rse_pf.server.live_map.owner.replies import paths_reply, relocalise_reply, show_reply, version_reply
from rse_pf.server.live_map.owner.state import Applied, MapState, Measuring, UpdateBook
from rse_pf.server.live_map.owner.threads import FIRST_RETRY_S, Urgency, next_retry_s
from rse_pf.slam.keyframe import decode_keyframe
from rse_pf.wire.live_map import (
    LEAVE,
    LIVE_REQUESTS,
    PUBLISH,
    STOP,
    KeyframeRequest,
    LiveForget,
    LiveMapRequest,
    LiveRelocalise,
    LiveRequest,
    LiveShow,
    LiveStart,
)

__all__ = ["LiveOwner", "MapMoves"]

# Time between two versions that a live map publishes while it changes.
PUBLISH_S = 600.0
_SETTLED_S = 5.0
"""An owner that served for this long does not die of its map; nor one that has measured a keyframe."""
_LAST_VERSION_S = 3.0
"""A map that is released waits for its last version no longer; the next owner publishes it then."""
_UNUSED_SHARE = 1.0 / 6.0
"""A map that got no command for this share of ``live.idle_s`` is only watched."""
_EVENT_BYTES = 512
"""Size of a keyframe's event in the log, without the keyframe."""
_WAITING = "waiting for the store"
_ALL_LEFT, _CHANGED, _UNUSED = AUTOMATIC_NOTES
_ALIGNING = (Joined, Corrected, Unaligned, Ambiguous, LoopClosureRejected)


class MapMoves(Busy):
    """The map is being given up: the worker sends the request to the next owner.

    Cause: The server of the owner drains, or was paused.
    Check: rse-pf map live list: which server owns the map.
    Fix: Nothing; the worker repeats the request.
    """


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
        self._writer = EntryWriter(
            log, take_entry=self.take_entry, on_lost=self.lose,
            on_waiting=lambda is_waiting: self.note_store(is_waiting=is_waiting),
            threads=context.threads, sleep=context.sleep, json_log=context.log, name=context.map_name,
        )  # fmt: skip
        self._measuring = Measuring(
            state, context.threads, self._writer.submit, fit=context.fit, json_log=context.log,
            name=context.map_name,
        )  # fmt: skip
        self._publisher = Publisher(state, context, server=lease.record.server)
        self._adding: dict[tuple[str, int], asyncio.Task[None]] = {}
        self._present: dict[str, None] = {}
        self._renewed = asyncio.Event()
        self._wrote_snapshot = self._unsaved_bytes = 0
        self._publish_due_s = context.clock() + PUBLISH_S
        self._untold = False
        self._is_waiting_for_store = self._is_closing = False
        self._idle_since_s = self._began_s = context.clock()
        self._is_used, self._used_s = False, float("-inf")
        self.users = 0
        """Connections; kept by the server."""
        self._ended: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def is_over(self) -> bool:
        """Whether the map is no longer this owner's, or is being given up."""
        return self._ended.done() or self._is_closing

    def present(self) -> list[dict[str, Any]]:
        """Return the payloads for a new reader, none while the lease may be another's."""
        return self._book.present() if self._is_owner() else []

    async def run(self) -> str:
        """Serve until the map is lost, released or stopped; return which."""
        alignments = await self._context.threads.compute(Urgency.APPLY, self._state.live_map.alignments)
        self._book.align(alignments, (), self._state.position)
        self._describe()
        begins = self._writer.run(), self._measuring.run(), self._keep_lease(), self._delete_gone_at_start()
        for work in begins:
            self._start(work)
        try:
            return await asyncio.shield(self._ended)
        finally:
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
            self._writer.refuse_all(self._moving)

    async def answer(self, robot: RobotId, operation: str, request: bytes) -> dict[str, Any]:
        """Do what a robot or an operator asks for, in a request as a link of a worker has encoded it.

        Raises:
            Busy: The map moves to another owner.
            RsePfError: The request is refused.
        """
        if self.is_over:
            raise self._moving()
        self._names[robot.folder] = robot.name
        self._note_use(is_used=True)
        reply = await self._reply_to(robot, operation, request)
        while operation != STOP and not self._is_owner():
            # it was paused, or cut off from the store: the map may be another's
            if self._ended.done():
                raise self._moving()
            self._renewed.clear()
            await self._renewed.wait()
        return reply

    async def release(self) -> None:
        """Write what waits and a snapshot, and let any server take the map at once."""
        await self._close(self._lease.release, "released")

    # --- requests -----------------------------------------------------------------------------------

    async def _reply_to(self, robot: RobotId, operation: str, data: bytes) -> dict[str, Any]:
        match _decode_request(operation, data):
            case KeyframeRequest() as request:
                return await self._take_keyframe(robot, request)
            case LiveRelocalise() as request:
                return await self._relocalise(request)
            case LiveForget() as request:
                return await self._forget(request)
            case LiveStart() as request:
                return await self._start_from(request)
            case LiveShow() as request:
                show = functools.partial(self._show, robot, request.paths)
                return await self._context.threads.compute(Urgency.ANSWER, show)
            case LiveMapRequest():
                return await self._reply_about(robot, operation)

    async def _reply_about(self, robot: RobotId, operation: str) -> dict[str, Any]:
        """Answer an operation whose request names the map alone."""
        if operation == LEAVE:
            return await self._leave(robot)
        if operation == PUBLISH:
            record = await self._publisher.publish(f"published by {robot}")
            return version_reply(self._context.map_name, record)
        return await self._stop()

    async def _take_keyframe(self, robot: RobotId, request: KeyframeRequest) -> dict[str, Any]:
        event = KeyframeAdded(
            robot=robot.folder, segment=request.segment, number=request.number, data=request.keyframe
        )
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
            verdict = await compute(Urgency.JUDGE, functools.partial(live_map.check_keyframe, event))
            if verdict == "known":
                return
            if verdict == "new":
                await self._charge(len(event.data) + _EVENT_BYTES)
                await asyncio.shield(self._writer.submit(event, len(event.data)))
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

    async def _charge(self, size: int) -> None:
        """Charge the tenant with an entry of *size* bytes; raises QuotaExceeded and StoreFull.

        A snapshot writes what keyframes saw once more, before the log is shortened: that must fit, too.
        """
        account = self._context.account
        if not account.try_charge(size):
            act = functools.partial(account.reserve, size, margin=self._unsaved_bytes + size)
            reserving = asyncio.ensure_future(self._context.threads.store(act))
            await asyncio.wait({reserving}, timeout=SLOW_STORE_S)
            if not reserving.done():
                self.note_store(is_waiting=True)
            try:
                await reserving
            except StoreFull:
                raise
            except StoreError:  # the store fails: the entry waits for it, and is counted later
                pass
        self._unsaved_bytes += size

    async def _relocalise(self, request: LiveRelocalise) -> dict[str, Any]:
        view = decode_keyframe(request.keyframe)
        threads, live_map = self._context.threads, self._state.live_map
        look = await threads.compute(Urgency.ANSWER, functools.partial(live_map.prepare_relocalisation, view))
        position = self._state.position
        return relocalise_reply(await threads.look(look), position)

    async def _leave(self, robot: RobotId) -> dict[str, Any]:
        if robot.folder in await self._context.threads.compute(
            Urgency.ANSWER, lambda: self._state.live_map.robots
        ):
            await asyncio.shield(self._writer.submit(RobotLeft(robot=robot.folder)))
        self._present.pop(robot.folder, None)
        if not self._present:
            self._publisher.ask(_ALL_LEFT)
            self._start(self._publisher.publish_due())
        return {}

    async def _forget(self, request: LiveForget) -> dict[str, Any]:
        known = await self._context.threads.compute(
            Urgency.ANSWER, lambda: list(self._state.live_map.contributors)
        )
        folders = [folder for folder in known if self._names.get(folder) == request.robot]
        folders += [each for each in folders_of(request.robot, known) if each not in folders]
        if not folders:
            raise NotFound(
                f"robot {request.robot[:80]!r} contributed nothing", hint="see rse-pf map live show MAP"
            )
        for folder in folders:
            await asyncio.shield(self._writer.submit(RobotForgotten(robot=folder)))
        await self._delete_gone()
        return {"forgotten": len(folders), "version": self._state.position}

    async def _delete_gone(self) -> None:
        """Delete what forgotten robots stored beside their keyframes; raises StoreError."""
        gone = await self._context.threads.compute(
            Urgency.ANSWER, lambda: self._state.live_map.deletable_objects
        )
        if gone:
            await self._context.threads.background(functools.partial(self._context.objects.delete_gone, gone))

    async def _cull(self, objects: list[tuple[str, str]]) -> None:
        """Delete what robots stored beside keyframes that were culled; those that stay go with the robot."""
        with contextlib.suppress(StoreError):
            await self._context.threads.background(functools.partial(self._context.objects.cull, objects))

    async def _delete_gone_at_start(self) -> None:
        """Do what the owner before may not have done; it is done again with each version, too."""
        with contextlib.suppress(StoreError):
            await self._delete_gone()

    async def _start_from(self, request: LiveStart) -> dict[str, Any]:
        if self._state.changes or self._state.keyframes:
            raise Conflict(
                f"the live map {self._context.map_name!r} has begun already",
                hint=f"stop it first: rse-pf map live stop {self._context.map_name}",
            )
        if request.source:
            version, source = await self._context.threads.background(
                lambda: version_to_start_from(self._context.maps, request)
            )
            event = await self._context.threads.background(
                lambda: self._context.kind.started_from(version, source)
            )
        else:
            event = MapStarted(source="", keyframes=())
        if request.source or request.equal_rooms_m:
            event = msgspec.structs.replace(event, equal_rooms_m=request.equal_rooms_m)
            await self._charge(sum(len(start.data) + _EVENT_BYTES for start in event.keyframes))
            await asyncio.shield(self._writer.submit(event))
        return {"keyframes": self._state.keyframes, "version": self._state.position}

    async def _stop(self) -> dict[str, Any]:
        record = None
        if self._state.keyframes:  # its log is deleted: over the quota, too, it becomes a version
            freed = await self._context.threads.background(self._log.charged_bytes)
            record = await self._publisher.publish("the live map was stopped", freed)
        await self._close(lambda: self._lease.stop(self._log.position), "stopped")
        with contextlib.suppress(StoreError):  # what is left is ignored, and deleted by the next owner
            await self._context.threads.background(
                functools.partial(self._log.delete_until, self._lease.record.base)
            )
        return {} if record is None else version_reply(self._context.map_name, record)

    def _show(self, robot: RobotId, with_paths: bool) -> dict[str, Any]:
        """Return the reply of ``live-show`` for *robot*; called in the thread of the map."""
        shown = show_reply(
            robot,
            self._state,
            self._lease.record,
            told_state=self._name_state(),
            name_of=self._name_of,
            is_present=self._present.__contains__,
        )
        paths = {"paths": paths_reply(self._state, self._name_of)} if with_paths else {}
        return {**shown, "images": self._context.settings.images, **paths}

    # --- the log ------------------------------------------------------------------------------------

    async def take_entry(self, position: int, batch: list[Submitted]) -> None:
        """Apply the events of an entry that is durable, answer who waits for them, and tell what is new."""
        events = [each.event for each in batch]
        compute = self._context.threads.compute
        applied, told, culled = await compute(Urgency.APPLY, functools.partial(self._apply, position, events))
        self._settle(batch, applied)
        if culled:
            self._start(self._cull(culled))
        for payload in told:
            self._tell(payload)
        if self._state.is_snapshot_due:
            self._start(self._write_snapshot(await self._snapshot()))

    def _apply(
        self, position: int, events: list[Event]
    ) -> tuple[Applied, list[dict[str, Any]], list[tuple[str, str]]]:
        """Apply an entry; return what to tell, and the objects of culled keyframes; in the map's thread."""
        applied = self._state.apply(position, events)
        outcomes = [each for found in applied.outcomes for each in found]
        self._log_alignments(outcomes)
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
        culled = [i for each in outcomes if isinstance(each, Culled) for i in each.ids]
        return applied, told, self._state.live_map.objects_of(culled) if culled else []

    def _log_alignments(self, outcomes: Iterable[Outcome]) -> None:
        for each in outcomes:
            if isinstance(each, Joined):
                self._context.log.info(
                    "live-aligned", map=self._context.map_name, robot=self._name_of(each.robot)
                )
            elif isinstance(each, Unaligned):
                self._context.log.warning(
                    "live-alignment-lost", map=self._context.map_name, robot=self._name_of(each.robot),
                    reason=each.reason,
                )  # fmt: skip

    def _settle(self, batch: list[Submitted], applied: Applied) -> None:
        for each, outcomes, defect in zip(batch, applied.outcomes, applied.defects, strict=True):
            if defect is not None:
                self._context.log.error("live-map-defect", map=self._context.map_name, error=repr(defect))
                each.done.set_exception(InternalError("the map failed on this event", hint="report it"))
            elif not each.done.done():
                each.done.set_result(outcomes)
            if any(isinstance(outcome, OptimiseWanted) for outcome in outcomes):
                self._measuring.optimise()
            if isinstance(each.event, KeyframeAdded):
                self._measuring.measure(outcome.id for outcome in outcomes if isinstance(outcome, Added))

    async def _snapshot(self) -> MapSnapshot:
        return await self._context.threads.compute(
            Urgency.APPLY, functools.partial(self._state.snapshot, self._log.stored_parts)
        )

    async def _write_snapshot(self, snapshot: MapSnapshot) -> None:
        unsaved_bytes = self._unsaved_bytes
        try:
            await self._context.threads.background(lambda: self._log.write_snapshot(snapshot))
        except StoreError as error:  # the next one is written later; a restart only takes longer
            self._context.log.warning("live-snapshot-failed", map=self._context.map_name, error=error.message)
        else:
            self._wrote_snapshot = snapshot.position
            self._unsaved_bytes -= unsaved_bytes

    # --- the lease ----------------------------------------------------------------------------------

    async def _keep_lease(self) -> None:
        settings, clock = self._context.settings, self._context.clock
        while not self._ended.done():
            is_settled = self._measuring.is_proven or clock() - self._began_s >= _SETTLED_S
            wait_s = renewal_s(settings.lease_s)
            try:
                is_ours = await self._context.threads.lease(
                    functools.partial(self._lease.renew, is_settled=is_settled)
                )
            except StoreError:
                wait_s = min(wait_s, FIRST_RETRY_S)
            else:
                if self._ended.done():
                    return
                if not is_ours:
                    self.lose("another process has taken the lease")
                    return
                self._after_renewal()
            await self._context.sleep(wait_s)

    def _after_renewal(self) -> None:
        settings: LiveSettings = self._context.settings
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
            self._publish_due_s = now + PUBLISH_S
            self._publisher.ask(_CHANGED)
        if now - self._used_s >= _UNUSED_SHARE * settings.idle_s:
            self._note_use(is_used=False)
        if self.users:
            self._idle_since_s = now
        elif now - self._idle_since_s >= settings.idle_s:
            self._idle_since_s = now
            self._start(self._end_idle())
        self._start(self._publisher.publish_due())

    def _note_use(self, *, is_used: bool) -> None:
        """Take that a command came, or none for a while."""
        if is_used:
            self._used_s = self._context.clock()
        if is_used != self._is_used:
            self._is_used = is_used
            self._context.on_use(is_used)

    async def _end_idle(self) -> None:
        """Publish the map, when it may be, and give it up; a version that fails is left to the next owner."""
        self._publisher.ask(_UNUSED)
        while self._publisher.is_due and not self._publisher.has_failed and not self.users:
            await self._publisher.publish_due()
            await self._context.sleep(renewal_s(self._context.settings.lease_s))
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
        await self._writer.wait_empty()
        snapshot = await self._snapshot()
        if how == "released" and snapshot.position > self._wrote_snapshot:
            await self._write_snapshot(snapshot)
        if how == "released":  # the next owner may come late: what is due is published before its time
            await asyncio.wait(
                {asyncio.ensure_future(self._publisher.publish_now())}, timeout=_LAST_VERSION_S
            )
        wait_s = FIRST_RETRY_S
        while not self._ended.done():
            try:
                is_ours = await self._context.threads.lease(give_up)
            except StoreError:
                await self._context.sleep(wait_s)
                wait_s = next_retry_s(wait_s)
            else:
                self._end(how if is_ours else "lost")

    def lose(self, reason: str) -> None:
        """Take that another process owns the map: end, and tell nothing more."""
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
        state = self._name_state()
        for payload in self._book.describe(
            keyframes=self._state.keyframes, version=self._state.position,
            owner=self._lease.record.server, state=state,
        ):  # fmt: skip
            if state == _WAITING:  # without the store nobody else can own the map
                self._context.tell(payload)
            else:
                self._tell(payload)

    def _name_state(self) -> str:
        if self._is_closing:
            return "moving"
        return _WAITING if self._is_waiting_for_store else "live"

    def note_store(self, *, is_waiting: bool) -> None:
        """Tell the robots that the store is slow or fails, or that it works again."""
        if is_waiting != self._is_waiting_for_store:
            self._is_waiting_for_store = is_waiting
            self._describe()

    def _name_of(self, folder: str) -> str:
        """Return the name under which the robot with this `RobotId.folder` is shown."""
        return self._names.get(folder) or shown_name(folder)

    def _moving(self) -> MapMoves:
        return MapMoves(
            "the live map moves to another server", hint="try again", retry_after_ms=BUSY_RETRY_MS
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


def _decode_request(operation: str, data: bytes) -> LiveRequest:
    """Return the request of *operation* as a link of a worker has encoded it.

    Raises:
        BadRequest: The bytes are no such request.
        UnknownService: There is no such operation.
    """
    kind = LIVE_REQUESTS.get(operation)
    if kind is None:
        raise UnknownService(f"no operation {operation[:80]!r} of live maps", hint="see docs/protocol.md")
    try:
        return msgspec.msgpack.decode(data, type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise BadRequest(
            f"the request of the live map is invalid: {message_of(error)}", hint="see docs/protocol.md"
        ) from error
