"""Serve one live map: the only process that changes the map, while it holds the lease of the map.

Two rules keep a map server that was paused or cut off from the store from contradicting its successor:

- An event is applied to the map only when its log entry is durable, and each number of an entry can be
  written once.
- A reply or an update is sent only if the last successful renewal of the lease began less than
  ``live.lease_s`` ago.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections.abc import Callable, Coroutine, Iterable
from typing import Any, Literal

from rse_pf.errors import Busy, InternalError, StoreError, StoreFull
from rse_pf.identity import RobotId
from rse_pf.live_map.events import Event, KeyframeAdded, RobotForgotten
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
from rse_pf.server.live_map.lease import MapLease, renewal_s
from rse_pf.server.live_map.map_server.environment import (
    FIRST_RETRY_S,
    MapServerEnvironment,
    Urgency,
    next_retry_s,
)
from rse_pf.server.live_map.map_server.log import BUSY_RETRY_MS, LiveLog, LogWriter, SubmittedEvent
from rse_pf.server.live_map.map_server.measurement import KeyframeMeasurer
from rse_pf.server.live_map.map_server.messages import MapUpdates, version_reply
from rse_pf.server.live_map.map_server.publisher import NOTE_CHANGED, NOTE_UNUSED, Publisher
from rse_pf.server.live_map.map_server.requests import RequestHandler
from rse_pf.server.live_map.map_server.state import AppliedEntry, MapState
from rse_pf.wire.live_map import STOP

__all__ = ["MapMoving", "MapServer", "ServiceEnd"]

PUBLISH_INTERVAL_S = 600.0
"""Interval in seconds at which a map server publishes the map if it has changed."""
_SETTLED_S = 5.0
"""Seconds after its start at which a map server counts as stable, so that earlier failures no longer delay a
takeover.  A map server that has measured all keyframes counts as stable at once: no keyframe that waited for
its measurement crashes the process."""
_MAX_FINAL_PUBLICATION_S = 3.0
"""Seconds for which the release of a map waits for the publication of its last version; if that takes longer,
the next map server publishes the version."""
_UNUSED_SHARE = 1.0 / 6.0
"""Fraction of ``live.idle_s``: a map without a command for this long counts as not used, whether or not it
has subscribers, and its process may be taken for another map."""
_WAITING_FOR_STORE = "waiting for the store"  # state of the map that subscribers are sent
_ALIGNMENT_OUTCOMES = (Joined, Corrected, Unaligned, Ambiguous, LoopClosureRejected)
"""Classes of outcomes that can change an alignment, or the reason why a robot has none."""

ServiceEnd = Literal["lost", "released", "stopped", "defect"]
"""Why a map server stopped serving: another process took the map, it was given up, an operator ended it, or
the map server has a defect."""


class MapMoving(Busy):
    """The live map is being given up: the worker sends the request to the next map server.

    Cause: The server of the map drains or was paused, nobody used the map, or another map needs its process.
    Check: rse-pf map live list: which server serves the map.
    Fix: Nothing; the worker repeats the request.
    """


class MapServer:
    """Serves one live map while it holds the map's lease: writes and applies the log, replies, sends updates.

    All methods are called in the event loop, except those whose docstrings name the thread of the map, the
    only thread that uses the map itself.
    """

    def __init__(
        self, environment: MapServerEnvironment, state: MapState, log: LiveLog, lease: MapLease
    ) -> None:
        """Prepare to serve; nothing happens before `run`.

        Args:
            environment: Threads, clocks, stores and listeners.
            state: The map, restored by `take_over`.
            log: Log of the map, at the position of *state*.
            lease: Lease of the map, which this process has claimed.
        """
        self.users = 0
        """Number of workers that are connected to this map server, which `WorkerConnections` maintains; after
        ``live.idle_s`` without a connected worker, the map is given up."""
        self._environment = environment
        self._state = state
        self._log = log
        self._lease = lease
        self._writer = LogWriter(
            log,
            environment,
            apply_entry=self.apply_entry,
            on_waiting=self.set_waiting_for_store,
            on_lost=self.lose,
        )
        self._measurer = KeyframeMeasurer(state, environment, self._writer.submit)
        self._publisher = Publisher(state, environment, server=lease.record.server)
        self._requests = RequestHandler(
            environment,
            state,
            lease,
            self._writer,
            self._publisher,
            charge=self.charge,
            service_state=self.service_state,
            start_task=self.start_task,
        )
        self._updates = MapUpdates(self._requests.name_of)
        self._renewed = asyncio.Event()
        self._snapshot_position = 0  # entry of the log at the last snapshot of this process; 0: none
        self._logged_bytes = 0  # bytes of the entries of this process, as they were charged
        self._saved_bytes = 0  # value of _logged_bytes at the last snapshot
        self._has_unsent_updates = False  # whether an update was not sent because the lease was too old
        self._is_waiting_for_store = False
        self._is_closing = False
        self._idle_since_s = self._began_s = environment.clock()
        self._publish_due_s = self._began_s + PUBLISH_INTERVAL_S
        self._last_command_s: float | None = None  # None: the worker knows that no commands arrive
        self._ended: asyncio.Future[ServiceEnd] = asyncio.get_running_loop().create_future()
        self._tasks: set[asyncio.Task[None]] = set()

    def current_updates(self) -> list[dict[str, Any]]:
        """Return the newest update of each key for a new subscriber.

        The list is empty while another process may hold the lease; after its next renewal, all updates are
        sent to every subscriber.
        """
        if self._holds_lease():
            return self._updates.all()
        self._has_unsent_updates = True
        return []

    async def run(self) -> ServiceEnd:
        """Serve until the map is lost, released or stopped, or a task of this object fails; return which.

        At the end, all tasks are cancelled, and events that are not applied yet are refused with `MapMoving`.
        """
        alignments = await self._environment.threads.compute(Urgency.APPLY, self._state.live_map.alignments)
        self._updates.set_alignments(alignments, (), self._state.position)
        self._send_map_state()
        for work in (
            self._writer.run(),
            self._measurer.run(),
            self._keep_lease(),
            self._delete_objects_of_forgotten(),
        ):
            self.start_task(work)
        try:
            return await asyncio.shield(self._ended)
        finally:
            for task in self._tasks:
                task.cancel()
            await asyncio.gather(*self._tasks, return_exceptions=True)
            self._writer.refuse_all(self._moving_error)

    async def answer(self, robot: RobotId, operation: str, request: bytes) -> dict[str, Any]:
        """Do what a robot or an operator requests, and return the reply.

        While the last successful renewal of the lease began ``live.lease_s`` ago or earlier, the reply is
        held back until the lease is renewed or lost.  Only the reply of ``live-stop``, which gives the lease
        up, is not held back.

        Args:
            robot: Robot that asks.
            operation: Name of the service, such as ``live-keyframe``.
            request: Request in MessagePack, as a worker encodes it.

        Raises:
            MapMoving: The map is being given up, or is lost.
            RsePfError: The request is refused.
        """
        if self._is_closing or self._ended.done():
            raise self._moving_error()
        self._note_command()
        if operation == STOP:
            return await self._stop_map()
        reply = await self._requests.answer(robot, operation, request)
        # While the lease is too old, another process may serve the map: the reply waits for a renewal.
        while not self._holds_lease():
            if self._ended.done():
                raise self._moving_error()
            self._renewed.clear()
            await self._renewed.wait()
        return reply

    async def release(self) -> None:
        """Give the map up, so that any server may take it.

        Submitted events are written and applied, a snapshot is written, a requested version is published if
        that takes at most 3 s, and the lease is released; that is tried until it succeeds or the lease is
        lost.
        """
        await self._close(self._lease.release, "released")

    # --- Entries of the log and snapshots ---

    async def apply_entry(self, position: int, batch: list[SubmittedEvent]) -> None:
        """Apply the events of the durable log entry *position*, and acknowledge them."""
        events = [submitted.event for submitted in batch]
        # 1. Apply the events in the thread of the map.
        applied, updates, culled = await self._environment.threads.compute(
            Urgency.APPLY, functools.partial(self._apply_events, position, events)
        )
        # 2. Answer the requests that wait for the events, and queue new keyframes for measurement.
        self._complete_events(batch, applied)
        # 3. Delete the stored points and images of keyframes whose features the map dropped.
        if culled:
            self.start_task(self._delete_objects_of_culled(culled))
        # 4. Send subscribers the changed alignments of the robots' newest segments, and the pose of each
        # keyframe that the entry added to an aligned segment; poses of earlier keyframes are not sent again.
        for update in updates:
            self._send_update(update)
        # 5. Begin to write a snapshot if enough entries were applied since the last one.
        if self._state.is_snapshot_due:
            self.start_task(self._write_snapshot())

    def _apply_events(
        self, position: int, events: list[Event]
    ) -> tuple[AppliedEntry, list[dict[str, Any]], list[tuple[str, str]]]:
        """Apply the events of an entry; called in the thread of the map.

        Alignments that were made or lost are written to the server's log.

        Returns:
            The effects of the entry on the map; the updates to send, which are the changed alignments and the
            poses of added keyframes; and the stored objects of culled keyframes as pairs of a robot's folder
            and a digest.
        """
        applied = self._state.apply(position, events)
        outcomes = [outcome for event_outcomes in applied.outcomes for outcome in event_outcomes]
        self._log_alignments(outcomes)
        updates: list[dict[str, Any]] = []
        keyframes = [event for event in events if isinstance(event, KeyframeAdded)]
        if (
            any(isinstance(outcome, _ALIGNMENT_OUTCOMES) for outcome in outcomes)
            or any(isinstance(event, RobotForgotten) for event in events)
            or not all(map(self._updates.has_segment, keyframes))
        ):
            alignments = self._state.live_map.alignments()
            updates += self._updates.set_alignments(alignments, outcomes, position)
        for keyframe in keyframes:
            updates += self._updates.add_pose(keyframe)
        culled = [id_ for outcome in outcomes if isinstance(outcome, Culled) for id_ in outcome.ids]
        return applied, updates, self._state.live_map.objects_of(culled) if culled else []

    async def _delete_objects_of_culled(self, culled: list[tuple[str, str]]) -> None:
        """Delete stored points and images of culled keyframes.

        An error of the store is ignored: the object that was due then stays until its robot is forgotten.
        """
        with contextlib.suppress(StoreError):
            await self._environment.threads.background(
                functools.partial(self._environment.objects.delete_of_culled, culled)
            )

    async def _delete_objects_of_forgotten(self) -> None:
        """Delete objects of forgotten robots that the previous map server did not delete.

        An error of the store is ignored, because each publication tries again.
        """
        with contextlib.suppress(StoreError):
            await self._requests.delete_objects_of_forgotten()

    def _log_alignments(self, outcomes: Iterable[Outcome]) -> None:
        """Log ``live-aligned`` or ``live-alignment-lost`` for each robot whose alignment was made or lost."""
        for outcome in outcomes:
            if isinstance(outcome, Joined):
                self._environment.log.info(
                    "live-aligned",
                    map=self._environment.map_name,
                    robot=self._requests.name_of(outcome.robot),
                )
            elif isinstance(outcome, Unaligned):
                self._environment.log.warning(
                    "live-alignment-lost",
                    map=self._environment.map_name,
                    robot=self._requests.name_of(outcome.robot),
                    reason=outcome.reason,
                )

    def _complete_events(self, batch: list[SubmittedEvent], applied: AppliedEntry) -> None:
        """Complete the futures of the events of an entry, and queue the work that follows from them.

        The future of an event on which the map failed gets an InternalError.  New keyframes are queued for
        measurement, and the whole pose graph for an optimisation if an outcome is `OptimiseWanted`.
        """
        for submitted, outcomes, defect in zip(batch, applied.outcomes, applied.defects, strict=True):
            if defect is None:
                submitted.applied.set_result(outcomes)
            else:
                self._environment.log.error(
                    "live-map-defect", map=self._environment.map_name, error=repr(defect)
                )
                submitted.applied.set_exception(
                    InternalError(
                        "the live map failed on this event, which may be applied in part",
                        hint="report the line live-map-defect of the server's log",
                    )
                )
            if any(isinstance(outcome, OptimiseWanted) for outcome in outcomes):
                self._measurer.request_optimisation()
            if isinstance(submitted.event, KeyframeAdded):
                self._measurer.add_keyframes(outcome.id for outcome in outcomes if isinstance(outcome, Added))

    async def charge(self, size_bytes: int) -> None:
        """Charge the tenant's quota with *size_bytes* that are written to the log next.

        The bytes that were logged since the last snapshot must be free in the quota as well, without being
        charged: the next snapshot stores their features a second time before log entries are deleted.  If the
        store fails in another way than by StoreFull, nothing is charged: the entry waits for the store, and
        `rse_pf.storage.quotas` counts it later.

        Raises:
            QuotaExceeded: The tenant would store more than its quota.
            StoreFull: The disk is nearly full, and the tenant holds more bytes than it may then.
            Busy: Other processes changed the account at each try.
        """
        account = self._environment.account
        if not account.try_charge(size_bytes):
            unsaved_bytes = self._logged_bytes - self._saved_bytes
            reserve = functools.partial(account.reserve, size_bytes, margin=unsaved_bytes + size_bytes)
            try:
                await self._environment.threads.store(reserve)
            except StoreFull:
                raise
            except StoreError:  # charge nothing: the entry waits until the store works, and is counted later
                pass
        self._logged_bytes += size_bytes

    async def _write_snapshot(self) -> None:
        """Write a snapshot; if the store fails, only warn, since a restart can read the log instead."""
        threads = self._environment.threads
        saved_bytes = self._logged_bytes
        snapshot = await threads.compute(
            Urgency.APPLY, functools.partial(self._state.make_snapshot, self._log.stored_parts)
        )
        try:
            await threads.background(functools.partial(self._log.write_snapshot, snapshot))
        except StoreError as error:
            self._environment.log.warning(
                "live-snapshot-failed", map=self._environment.map_name, error=error.message
            )
        else:
            self._snapshot_position = snapshot.position
            self._saved_bytes = saved_bytes

    # --- Renewal of the lease, and the end of the service ---

    async def _keep_lease(self) -> None:
        """Renew the lease until the service ends; end it as lost if another process has taken the lease.

        The lease is renewed three times within ``live.lease_s``, and 0.05 s after a failure of the store.
        """
        environment = self._environment
        while not self._ended.done():
            age_s = environment.clock() - self._began_s
            is_settled = self._measurer.is_proven or age_s >= _SETTLED_S
            wait_s = renewal_s(environment.settings.lease_s)
            try:
                is_held = await environment.threads.lease(
                    functools.partial(self._lease.renew, is_settled=is_settled)
                )
            except StoreError:
                wait_s = min(wait_s, FIRST_RETRY_S)
            else:
                if self._ended.done():
                    return
                if not is_held:
                    self.lose("another process has taken the lease")
                    return
                self._after_renewal()
            await environment.sleep(wait_s)

    def _after_renewal(self) -> None:
        """Send updates and replies that waited, and publish or give up the map if that is due.

        Called after each successful renewal of the lease.
        """
        environment = self._environment
        now = environment.clock()
        # 1. Send replies and updates that waited for the renewal; while the map is given up, do no more.
        self._renewed.set()
        if self._has_unsent_updates:
            self._has_unsent_updates = False
            for update in self._updates.all():
                self._send_update(update)
        environment.on_renewal(self._lease.record.beat)
        self._send_map_state()
        if self._is_closing:
            return
        # 2. Request a version of the map every 10 minutes.
        if now >= self._publish_due_s:
            self._publish_due_s = now + PUBLISH_INTERVAL_S
            self._publisher.request(NOTE_CHANGED)
        # 3. Notify the worker if commands have ceased, and give up a map to which no worker was connected for
        # ``live.idle_s``.
        unused_s = _UNUSED_SHARE * environment.settings.idle_s
        if self._last_command_s is not None and now - self._last_command_s >= unused_s:
            self._last_command_s = None
            environment.on_use(False)
        if self.users:
            self._idle_since_s = now
        elif now - self._idle_since_s >= environment.settings.idle_s:
            self._idle_since_s = now
            self.start_task(self._give_up_idle_map())
        # 4. Publish the requested version if the map has changed and ``live.publish_pause_s`` has passed.
        self.start_task(self._publisher.publish_due())

    def _note_command(self) -> None:
        """Note the time of a command; notify the worker that the map is used, if it was not used before."""
        if self._last_command_s is None:
            self._environment.on_use(True)
        self._last_command_s = self._environment.clock()

    async def _give_up_idle_map(self) -> None:
        """Publish the map if it has changed, and release it unless a worker has connected meanwhile.

        If the publication fails, the map is released, and the next map server publishes it.
        """
        self._publisher.request(NOTE_UNUSED)
        await self._publisher.publish_now()
        if not self.users:
            await self.release()

    def _holds_lease(self) -> bool:
        """Return whether no other process can have taken the map until now, since the lease is new enough."""
        return not self._ended.done() and self._lease.age_s < self._environment.settings.lease_s

    async def _close(self, give_up: Callable[[], bool], end: ServiceEnd) -> None:
        """Write all submitted events, change the lease by *give_up*, and end the service with *end*.

        The service ends with "lost" if *give_up* returns False, because another process has the lease.  While
        the map is already being given up, a further call only waits for the end.
        """
        if self._is_closing:
            await asyncio.shield(self._ended)
            return
        self._is_closing = True
        self._send_map_state()
        # 1. Wait until submitted events are written and applied.
        await self._writer.wait_empty()
        if end == "released":
            # 2. Write a snapshot unless this process wrote one after the last entry, so that the next map
            # server starts fast.
            if self._state.position > self._snapshot_position:
                await self._write_snapshot()
            # 3. Publish a requested version without the pause of ``live.publish_pause_s``, because the next
            # map server may start late; wait for that at most 3 s.
            await asyncio.wait(
                {asyncio.ensure_future(self._publisher.publish_now())}, timeout=_MAX_FINAL_PUBLICATION_S
            )
        # 4. Give the lease up; try again until the store works or the lease is lost.
        wait_s = FIRST_RETRY_S
        while not self._ended.done():
            try:
                was_held = await self._environment.threads.lease(give_up)
            except StoreError:
                await self._environment.sleep(wait_s)
                wait_s = next_retry_s(wait_s)
            else:
                self._end(end if was_held else "lost")

    async def _stop_map(self) -> dict[str, Any]:
        """Publish the map, give its lease up as stopped, and delete its log.

        The reply names the version; it is empty if the map has no keyframes.  If the publication fails, the
        map continues to be served, and the error is raised.
        """
        background, record = self._environment.threads.background, None
        # 1. Publish the map as a version.  The log is deleted afterwards, so its bytes need not be free in
        # the quota a second time.
        if self._state.keyframes:
            freed_bytes = await background(self._log.charged_bytes)
            record = await self._publisher.publish("the live map was stopped", freed_bytes)
        # 2. Give the lease up, and write into it the position of the log at which the map was stopped.
        await self._close(lambda: self._lease.stop(self._log.position), "stopped")
        # 3. Delete the log; entries that stay after an error are ignored by the next map server.
        with contextlib.suppress(StoreError):
            await background(functools.partial(self._log.delete_until, self._lease.record.base))
        return {} if record is None else version_reply(self._environment.map_name, record)

    def lose(self, reason: str) -> None:
        """End the service, because another process serves the map; *reason* is logged."""
        self._environment.log.warning("live-map-lost", map=self._environment.map_name, reason=reason)
        self._end("lost")

    def _end(self, end: ServiceEnd) -> None:
        """Let `run` return *end*, unless the service has ended; wake replies that wait for a renewal."""
        if not self._ended.done():
            self._ended.set_result(end)
        self._renewed.set()

    # --- Updates for subscribers ---

    def _send_update(self, payload: dict[str, Any]) -> None:
        """Send an update; if the lease is too old, let all updates be sent after its next renewal instead."""
        if self._holds_lease():
            self._environment.send_update(payload)
        else:
            self._has_unsent_updates = True

    def _send_map_state(self) -> None:
        """Send the update ``map`` (size, position in the log, server and state) if it has changed."""
        service_state = self.service_state()
        for payload in self._updates.set_map(
            keyframes=self._state.keyframes,
            version=self._state.position,
            server=self._lease.record.server,
            state=service_state,
        ):
            # This state is sent also with a lease that is too old: while the store fails, no other process
            # can take the lease and contradict it.
            if service_state == _WAITING_FOR_STORE:
                self._environment.send_update(payload)
            else:
                self._send_update(payload)

    def service_state(self) -> str:
        """Return what the map does: ``live``, ``waiting for the store``, or ``moving`` to another server."""
        if self._is_closing:
            return "moving"
        return _WAITING_FOR_STORE if self._is_waiting_for_store else "live"

    def set_waiting_for_store(self, is_waiting: bool) -> None:
        """Set whether the map waits for the store; notify subscribers if that changes."""
        if is_waiting != self._is_waiting_for_store:
            self._is_waiting_for_store = is_waiting
            self._send_map_state()

    def _moving_error(self) -> MapMoving:
        return MapMoving(
            "the live map is moving to another server",
            hint="send the request again",
            retry_after_ms=BUSY_RETRY_MS,
        )

    def start_task(self, work: Coroutine[Any, Any, None]) -> None:
        """Run *work* as a task until the service ends; an exception of it ends the service as a defect."""
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._on_task_end)

    def _on_task_end(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled() and task.exception() is not None:
            self._environment.log.error(
                "live-owner-defect", map=self._environment.map_name, error=repr(task.exception())
            )
            self._end("defect")
