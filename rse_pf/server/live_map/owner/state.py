"""A live map as its owner holds it: restored from the log, changed by entries only, and measured afterwards.

Two processes that read the same log hold the same map; `MapState.digest` shows it.  The links of a keyframe
are measured after it was applied, while the map goes on, and enter the log as events, too.  `UpdateBook` has
what the robots were told: a payload is told when it differs from the last one of its key, and a new reader
gets all of them.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from rse_pf.errors import BadRequest, NotFound
from rse_pf.geometry import Array, scaled
from rse_pf.live_map.events import (
    Event,
    KeyframeAdded,
    LoopClosuresMeasured,
    MapServerChanged,
    MapStarted,
    Optimised,
    RobotLeft,
    decode_events,
    encode_events,
    matrix_bytes,
)
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.measure import merge_measurements
from rse_pf.live_map.outcomes import Added, Alignment, Corrected, Outcome
from rse_pf.live_map.versions import started_from
from rse_pf.maps.format import MapVersion
from rse_pf.server.live_map.owner.log import LiveLog, MapSnapshot, OwnershipLost, snapshot_entries
from rse_pf.server.live_map.owner.threads import OwnerThreads, Urgency
from rse_pf.server.live_map.owner.whole_fit import WholeFit
from rse_pf.server.log import JsonLog

__all__ = [
    "LIVE_MAP",
    "Applied",
    "MapKind",
    "MapState",
    "Measuring",
    "UpdateBook",
    "candidates_of",
    "restore",
    "take_over",
    "upper_triangle",
]

_T = TypeVar("_T")
Payload = dict[str, Any]
_UPPER = np.triu_indices(6)
_NEVER = ("cause", "version")
"""A payload that differs in these only is not told again."""
_UNCHANGING = (MapServerChanged, RobotLeft)
_AT_ONCE = 2
"""OwnerThreads that measure: both share one keyframe, or take one each where more wait."""
_FEW_WAIT, _FEWER, _FEWEST = 4, 6, 4
"""Where more keyframes wait than the first number, a keyframe is compared with so many others; where twice as
many wait, with the last number."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MapKind:
    """How a map is made: empty, from the head and parts of a snapshot, and from a version of the registry."""

    empty: Callable[[], LiveMap]
    restore: Callable[[bytes, Callable[[str], bytes]], LiveMap]
    started_from: Callable[[MapVersion, str], MapStarted]


LIVE_MAP = MapKind(empty=LiveMap, restore=LiveMap.restore_parts, started_from=started_from)
"""The map that owners serve."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Applied:
    """What an entry changed: outcomes and defects by event."""

    outcomes: list[list[Outcome]]
    defects: list[Exception | None]


class MapState:
    """The map, and which of its keyframes still have to be measured.  For one thread at a time."""

    def __init__(self, live_map: LiveMap, position: int, unmeasured: Sequence[int] = ()) -> None:
        """Begin with the map after the entry *position*."""
        self.live_map = live_map
        self.position = position
        self.unmeasured = dict.fromkeys(unmeasured)
        self.changes = 0
        """How many events have changed the map since this object was made."""
        self.keyframes = live_map.keyframes
        self._snapshot_at = position

    def apply(self, position: int, events: Sequence[Event]) -> Applied:
        """Change the map by the entry *position*, which is durable.

        A defect of the map's logic stops one event, here and in every replay; lack of memory ends the
        process.
        """
        outcomes: list[list[Outcome]] = []
        defects: list[Exception | None] = []
        for event in events:
            found, defect = self._apply(event)
            outcomes.append(found)
            defects.append(defect)
        self.position = position
        self.keyframes = self.live_map.keyframes
        return Applied(outcomes=outcomes, defects=defects)

    def measuring(
        self, keyframe: int, pieces: int, candidates: int | None = None
    ) -> list[Callable[[], LoopClosuresMeasured]]:
        """Return what measures the links of a keyframe, in any thread, while the map changes.

        It is compared with *candidates*, None for as many as the map likes.  `merge_measurements` joins what
        the pieces find.  After a defect there are none, with the reason ``defect``.
        """
        defect = LoopClosuresMeasured(keyframe=keyframe, failed={"defect": 1})
        found = _guarded(lambda: self.live_map.prepare_measurement(keyframe, pieces, candidates))
        if found is None:
            return [lambda: defect]
        return [functools.partial(_links, measure, defect) for measure in found]

    def optimising(self, solve: WholeFit) -> Callable[[], Optimised | None]:
        """Return what fits the whole graph, in any thread, while the map changes; None if that fails."""
        fit = _guarded(lambda: self.live_map.prepare_optimisation(solve))
        return lambda: None if fit is None else _guarded(fit)

    @property
    def is_snapshot_due(self) -> bool:
        """Whether so many entries were applied since the last snapshot that a restart takes long."""
        return self.position - self._snapshot_at >= snapshot_entries(self.keyframes)

    def snapshot(self, known: Collection[str]) -> MapSnapshot:
        """Return the snapshot after the last entry; parts that are *known* are stored already."""
        self._snapshot_at = self.position
        made = self.live_map.snapshot_parts(known)
        return MapSnapshot(
            position=self.position, unmeasured=tuple(self.unmeasured), head=made.head, parts=made.parts
        )

    def digest(self) -> str:
        """Return the digest of the map."""
        return self.live_map.digest()

    def _apply(self, event: Event) -> tuple[list[Outcome], Exception | None]:
        try:
            outcomes = self.live_map.apply(event)
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001  every replay must get past it, too
            return [], error
        if isinstance(event, KeyframeAdded):
            self.unmeasured |= dict.fromkeys(each.id for each in outcomes if isinstance(each, Added))
        elif isinstance(event, LoopClosuresMeasured):
            self.unmeasured.pop(event.keyframe, None)
        self.changes += not isinstance(event, _UNCHANGING)
        return outcomes, None


def _guarded(act: Callable[[], _T]) -> _T | None:
    """Return what *act* returns, None after a defect: a measurement must not end the owner."""
    try:
        return act()
    except MemoryError:
        raise
    except Exception:  # noqa: BLE001  whatever the defect is
        return None


def _links(
    measure: Callable[[], LoopClosuresMeasured], otherwise: LoopClosuresMeasured
) -> LoopClosuresMeasured:
    found = _guarded(measure)
    return otherwise if found is None else found


def restore(log: LiveLog, kind: MapKind) -> MapState:
    """Return the map that the log holds now, and write nothing; raises StoreError."""
    state = _from_snapshot(log, kind)
    for entry in log.entries():
        state.apply(log.position, decode_events(entry.events))
    return state


def take_over(log: LiveLog, kind: MapKind, *, owner: str, epoch: int) -> MapState:
    """Return the map that the log holds, with the entry that says who owns it from here on.

    Until that entry is written the previous owner may still write; afterwards it cannot.

    Raises:
        OwnershipLost: A later owner has written.
        StoreError: The store fails, or the log is damaged.
    """
    state = _from_snapshot(log, kind)
    change = [MapServerChanged(owner=owner, epoch=epoch)]
    data = encode_events(change)
    while True:
        for entry in log.entries():
            if entry.epoch > epoch:
                raise OwnershipLost(f"owner {entry.owner} has taken the map over")
            state.apply(log.position, decode_events(entry.events))
        try:
            state.apply(log.write(data), change)
        except OwnershipLost:
            continue  # the previous owner has just written; read on
        return state


def _from_snapshot(log: LiveLog, kind: MapKind) -> MapState:
    """Return the map of the newest snapshot that this version can read, or an empty one."""
    for snapshot in log.snapshots():
        with contextlib.suppress(BadRequest, NotFound):
            live_map = kind.restore(snapshot.head, log.part)
            return MapState(live_map, snapshot.position, snapshot.unmeasured)
    return MapState(kind.empty(), log.position)


def candidates_of(waiting: int) -> int | None:
    """Return with how many others a keyframe is compared while *waiting* others wait; None for all.

    A replay does not depend on it, because the links that are found are in the log.
    """
    if waiting <= _FEW_WAIT:
        return None
    return _FEWER if waiting <= 2 * _FEW_WAIT else _FEWEST


class Measuring:
    """Measures one keyframe or two at a time; its methods are called in the event loop."""

    def __init__(
        self,
        state: MapState,
        threads: OwnerThreads,
        submit: Callable[[Event], Any],
        *,
        fit: WholeFit,
        json_log: JsonLog,
        name: str,
    ) -> None:
        """Begin with what the last owner has left, at `run`.

        Args:
            state: The map.
            threads: The threads that measure.
            submit: Appends an event to the log.
            fit: Fits the whole graph.
            json_log: The log of the server.
            name: Name of the map.
        """
        self._state, self._threads, self._submit = state, threads, submit
        self._fit, self._json_log, self._name = fit, json_log, name
        self._waiting = deque(state.unmeasured)
        self._wake = asyncio.Event()
        self._wake.set()
        self._optimise_wanted = False
        self._has_measured = False

    @property
    def is_proven(self) -> bool:
        """Whether a keyframe has gone the whole way, and none is left that may end the process."""
        return self._has_measured and not self._state.unmeasured

    def measure(self, keyframes: Iterable[int]) -> None:
        """Measure these keyframes, too."""
        self._waiting.extend(keyframes)
        self._wake.set()

    def optimise(self) -> None:
        """Fit the whole graph when no keyframe waits."""
        self._optimise_wanted = True
        self._wake.set()

    async def run(self) -> None:
        """Work until cancelled."""
        await asyncio.gather(*(self._work() for _ in range(_AT_ONCE)))

    async def _work(self) -> None:
        while True:
            await self._wake.wait()
            if self._waiting:
                await self._measure(self._waiting.popleft())
            elif self._optimise_wanted:
                self._optimise_wanted = False
                await self._optimise()
            else:
                self._wake.clear()

    async def _measure(self, keyframe: int) -> None:
        threads, waiting = self._threads, len(self._waiting)
        look = functools.partial(
            self._state.measuring, keyframe, 1 if waiting else _AT_ONCE, candidates_of(waiting)
        )
        pieces = await threads.compute(Urgency.MEASURE, look)
        begun = [threads.look(measure) for measure in pieces]
        self._submit(merge_measurements(keyframe, [await each for each in begun]))
        self._has_measured = True

    async def _optimise(self) -> None:
        begin = functools.partial(self._state.optimising, self._fit)
        fit = await self._threads.compute(Urgency.BACKGROUND, begin)
        optimised = await self._threads.look(fit)
        if optimised is None:
            self._json_log.warning("live-optimisation-failed", map=self._name)
        else:
            self._submit(optimised)


class UpdateBook:
    """The present state of one map as payloads by key."""

    def __init__(self, name_of: Callable[[str], str]) -> None:
        """Know nothing yet; *name_of* returns the name under which a `RobotId.folder` is shown."""
        self._name_of = name_of
        self._payloads: dict[str, Payload] = {}
        self._alignments: dict[str, Alignment] = {}

    def present(self) -> list[Payload]:
        """Return all payloads, those of the map first."""
        return sorted(self._payloads.values(), key=lambda each: str(each["kind"]) != "map")

    def align(
        self, alignments: Iterable[Alignment], outcomes: Iterable[Outcome], version: int
    ) -> list[Payload]:
        """Take where the segments lie now, and return what is new; outcomes name the causes."""
        causes = {each.robot: each.cause for each in outcomes if isinstance(each, Corrected)}
        self._alignments = {each.robot: each for each in alignments}
        told = []
        for folder, each in self._alignments.items():
            cause = causes.get(folder)
            payload = {
                "kind": "alignment", "robot": self._name_of(folder), "segment": each.segment,
                "aligned": each.aligned, "reason": each.reason, "T_map_odom": _matrix(each.T_map_odom),
                "version": version,
                "covariance": None if each.covariance is None else upper_triangle(each.covariance),
                "cause": None if cause is None else {"robot": self._name_of(cause[0]), "number": cause[1]},
            }  # fmt: skip
            if each.scale is not None:
                payload["scale"] = each.scale
            told += self._put(payload)
        gone = {
            f"{kind}/{self._name_of(folder)}" for kind in ("alignment", "pose") for folder in self._alignments
        }
        for key in [key for key in self._payloads if key != "map" and key not in gone]:
            del self._payloads[key]
        return told

    def place(self, event: KeyframeAdded) -> list[Payload]:
        """Take a keyframe, and return the pose that the robot had there if its segment is aligned."""
        found = self._alignments.get(event.robot)
        if found is None or not found.aligned or found.segment != event.segment or found.T_map_odom is None:
            return []
        T_map_camera = found.T_map_odom @ scaled(event.keyframe.T_odom_camera, found.scale or 1.0)
        return self._put(
            {
                "kind": "pose",
                "robot": self._name_of(event.robot),
                "segment": event.segment,
                "timestamp_s": event.keyframe.timestamp_s,
                "T_map_camera": matrix_bytes(T_map_camera),
            }
        )

    def knows_segment(self, event: KeyframeAdded) -> bool:
        """Return whether the segment of a keyframe is the one that was last told."""
        found = self._alignments.get(event.robot)
        return found is not None and found.segment == event.segment

    def describe(self, *, keyframes: int, version: int, owner: str, state: str) -> list[Payload]:
        """Take the state of the map, and return it if it is new."""
        payload = {"kind": "map", "keyframes": keyframes, "version": version, "owner": owner, "state": state}
        is_new = payload != self._payloads.get("map")
        self._payloads["map"] = payload
        return [payload] if is_new else []

    def _put(self, payload: Payload) -> list[Payload]:
        key = f"{payload['kind']}/{payload['robot']}"
        before = self._payloads.get(key)
        self._payloads[key] = payload
        return [] if before is not None and _without_cause(before) == _without_cause(payload) else [payload]


def _without_cause(payload: Payload) -> Payload:
    return {name: value for name, value in payload.items() if name not in _NEVER}


def _matrix(matrix: Array | None) -> bytes | None:
    return None if matrix is None else matrix_bytes(matrix)


def upper_triangle(covariance: Array) -> bytes:
    """Return the 21 numbers of a ``(6, 6)`` covariance on and above its diagonal, row by row."""
    return matrix_bytes(covariance[_UPPER])
