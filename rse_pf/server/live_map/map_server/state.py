"""Hold a live map in its map server: restored from the log, and changed only by durable entries of the log.

All processes that read the same log hold the same map to the byte, and `MapState.digest` is then equal.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TypeVar

from rse_pf.errors import BadRequest, NotFound
from rse_pf.live_map.events import (
    Event,
    KeyframeAdded,
    LoopClosuresMeasured,
    MapServerChanged,
    Optimised,
    RobotLeft,
    decode_events,
    encode_events,
)
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.outcomes import Added, Outcome
from rse_pf.server.live_map.map_server.environment import GraphOptimiser, MapImplementation
from rse_pf.server.live_map.map_server.log import (
    LeaseLost,
    LiveLog,
    MapSnapshot,
    entries_between_snapshots,
)

__all__ = ["AppliedEntry", "MapState", "restore", "take_over"]

_T = TypeVar("_T")
_EVENTS_WITHOUT_CHANGE = (MapServerChanged, RobotLeft)
"""Classes of events after which a version of the map would have the same content as before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AppliedEntry:
    """The effects of the events of one log entry.

    Attributes:
        outcomes: For each event, its outcomes; empty for an event with a defect, which may be applied in
            part.
        defects: For each event, the exception that the map raised while the event was applied; else None.
    """

    outcomes: list[list[Outcome]]
    defects: list[Exception | None]


class MapState:
    """A live map with its position in the log, and the keyframes whose loop closures are not logged yet.

    All methods are called by one thread at a time; functions that they return may be called in any thread.
    """

    def __init__(self, live_map: LiveMap, position: int, unmeasured: Sequence[int] = ()) -> None:
        """Hold *live_map* as it is after the log entry *position*.

        Args:
            live_map: The map.
            position: Number of the last entry that was applied to it.
            unmeasured: Ids of its keyframes whose loop closures have not been logged.
        """
        self.live_map = live_map
        self.position = position
        self.unmeasured = dict.fromkeys(unmeasured)
        """Ids of keyframes whose loop closures have not been logged, in the order of their arrival."""
        self.changes = 0
        """Number of events since this object was made, without those that leave a version of the map as it
        was (`_EVENTS_WITHOUT_CHANGE`) and those that failed."""
        self.keyframes = live_map.keyframes
        """Number of keyframes in the map whose features are kept, after the last applied entry."""
        self._snapshot_position = position  # entry after which the last snapshot was made or restored

    def apply(self, position: int, events: Sequence[Event]) -> AppliedEntry:
        """Apply the events of the durable log entry *position* to the map, in their order.

        If the map raises an exception for an event (a defect of the program), the exception is returned, and
        the next event is applied.  What the failed event has changed until then stays, and is the same in
        every replay.  MemoryError is raised, and ends the process.
        """
        outcomes: list[list[Outcome]] = []
        defects: list[Exception | None] = []
        for event in events:
            event_outcomes, defect = self._apply_event(event)
            outcomes.append(event_outcomes)
            defects.append(defect)
        self.position = position
        self.keyframes = self.live_map.keyframes
        return AppliedEntry(outcomes=outcomes, defects=defects)

    def prepare_measurement(
        self, keyframe: int, parts: int, candidates: int | None = None
    ) -> list[Callable[[], LoopClosuresMeasured]]:
        """Return functions that measure the loop closures of a keyframe; the map does not change.

        The functions work on copies, so the map may change while they run.

        Args:
            keyframe: Id of the keyframe.
            parts: Largest number of functions; the candidates are distributed among them.
            candidates: Largest number of keyframes with which it is compared; None for the map's own limit.

        Returns:
            Functions whose results `merge_measurements` combines.  A function that fails because of a defect
            returns no loop closures and the failure reason ``defect``.
        """
        defect = LoopClosuresMeasured(keyframe=keyframe, failed={"defect": 1})
        prepare = functools.partial(self.live_map.prepare_measurement, keyframe, parts, candidates)
        measurements = _call_guarded(prepare, on_defect=[lambda: defect])
        return [functools.partial(_call_guarded, measure, on_defect=defect) for measure in measurements]

    def prepare_optimisation(self, optimise: GraphOptimiser) -> Callable[[], Optimised | None]:
        """Return a function that optimises a copy of the whole pose graph; the map does not change.

        The function calls *optimise*, while the map may change, and returns the event with the new poses;
        None if any exception but MemoryError was raised.
        """
        prepare = functools.partial(self.live_map.prepare_optimisation, optimise)
        optimisation = _call_guarded(prepare, on_defect=None)
        return lambda: None if optimisation is None else _call_guarded(optimisation, on_defect=None)

    @property
    def is_snapshot_due(self) -> bool:
        """Whether `entries_between_snapshots` log entries were applied since the last snapshot.

        That is the last one that `make_snapshot` made, else the one from which the map was restored.
        """
        return self.position - self._snapshot_position >= entries_between_snapshots(self.keyframes)

    def make_snapshot(self, stored_parts: Collection[str]) -> MapSnapshot:
        """Return the snapshot after the last applied entry; `is_snapshot_due` counts entries from it on.

        Parts whose names are in *stored_parts* are not encoded again: their content is None.
        """
        self._snapshot_position = self.position
        parts = self.live_map.snapshot_parts(stored_parts)
        return MapSnapshot(
            position=self.position, unmeasured=tuple(self.unmeasured), head=parts.head, parts=parts.parts
        )

    def digest(self) -> str:
        """Return the SHA-256 in hex of the pose graph with all features, by which replays are compared."""
        return self.live_map.digest()

    def _apply_event(self, event: Event) -> tuple[list[Outcome], Exception | None]:
        """Apply *event*; return its outcomes and None, or no outcomes and the exception of the map."""
        try:
            outcomes = self.live_map.apply(event)
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001  a defect must not stop this process, nor any replay
            return [], error
        if isinstance(event, KeyframeAdded):
            self.unmeasured |= dict.fromkeys(outcome.id for outcome in outcomes if isinstance(outcome, Added))
        elif isinstance(event, LoopClosuresMeasured):
            self.unmeasured.pop(event.keyframe, None)
        self.changes += not isinstance(event, _EVENTS_WITHOUT_CHANGE)
        return outcomes, None


def _call_guarded(act: Callable[[], _T], *, on_defect: _T) -> _T:
    """Return the result of *act*, or *on_defect* if it raises anything but MemoryError.

    A defect in one measurement must not stop the map server.
    """
    try:
        return act()
    except MemoryError:
        raise
    except Exception:  # noqa: BLE001  every kind of defect
        return on_defect


def restore(log: LiveLog, implementation: MapImplementation) -> MapState:
    """Return the map at the end of its log, without writing anything.

    Raises:
        StoreError: The store fails, or an entry of the log is missing or damaged.
        BadRequest: The events of an entry are damaged.
    """
    state = _restore_snapshot(log, implementation)
    for entry in log.read_entries():
        state.apply(log.position, decode_events(entry.events))
    return state


def take_over(log: LiveLog, implementation: MapImplementation, *, owner: str, epoch: int) -> MapState:
    """Restore the map and write the log entry after which the previous map server can write no more.

    Args:
        log: Log of the map; the calling process holds the lease.
        implementation: Makes the map.
        owner: Name of the calling process.
        epoch: Epoch of its lease.

    Raises:
        LeaseLost: A process with a later epoch has written to the log.
        StoreError: The store fails, or an entry of the log is missing or damaged.
        BadRequest: The events of an entry are damaged.
    """
    # 1. Restore the newest snapshot.
    state = _restore_snapshot(log, implementation)
    owner_change = [MapServerChanged(owner=owner, epoch=epoch)]
    data = encode_events(owner_change)
    while True:
        # 2. Apply the entries after the last applied one.
        for entry in log.read_entries():
            if entry.epoch > epoch:
                raise LeaseLost(f"the process {entry.owner} has taken the map over")
            state.apply(log.position, decode_events(entry.events))
        # 3. Write and apply an entry that names this map server.  If the previous one has just written an
        # entry with this number, go back to step 2, which reads that entry.
        try:
            state.apply(log.write_entry(data), owner_change)
        except LeaseLost:
            continue
        return state


def _restore_snapshot(log: LiveLog, implementation: MapImplementation) -> MapState:
    """Return the map of the newest snapshot that can be restored, or an empty map if there is none.

    ``log.position`` is then the position of that snapshot, or the base of the log.
    """
    for snapshot in log.read_snapshots():
        with contextlib.suppress(BadRequest, NotFound):
            live_map = implementation.restore(snapshot.head, log.read_part)
            return MapState(live_map, snapshot.position, snapshot.unmeasured)
    return MapState(implementation.empty(), log.position)
