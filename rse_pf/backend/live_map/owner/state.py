"""A live map as its owner holds it: restored from the log, changed by entries only.

Two processes that read the same log hold the same map; `MapState.digest` shows it.  No store, no thread.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TypeVar

from rse_pf.backend.live_map.owner.log import LiveLog, MapSnapshot, OwnershipLost, snapshot_entries
from rse_pf.backend.live_map.owner.work.whole_fit import WholeFit
from rse_pf.errors import BadRequest, NotFound
from rse_pf.live_map.events import (
    Event,
    KeyframeAdded,
    LinksMeasured,
    MapStarted,
    Optimised,
    OwnerChanged,
    RobotLeft,
    decode_events,
    encode_events,
)
from rse_pf.live_map.live_map import LiveMap
from rse_pf.live_map.outcomes import Added, Outcome
from rse_pf.maps.format import MapVersion

__all__ = ["Applied", "MapKind", "MapState", "restore", "take_over"]

_T = TypeVar("_T")
_UNCHANGING = (OwnerChanged, RobotLeft)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapKind:
    """How a map is made: empty, from the head and parts of a snapshot, and from a version of the registry."""

    empty: Callable[[], LiveMap]
    restore: Callable[[bytes, Callable[[str], bytes]], LiveMap]
    started_from: Callable[[MapVersion, str], MapStarted]


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
    ) -> list[Callable[[], LinksMeasured]]:
        """Return what measures the links of a keyframe, in any thread, while the map changes.

        It is compared with *candidates*, None for as many as the map likes.  `joined_links` joins what the
        pieces find.  After a defect there are none, with the reason ``defect``.
        """
        defect = LinksMeasured(keyframe=keyframe, failed={"defect": 1})
        found = _guarded(lambda: self.live_map.measuring(keyframe, pieces, candidates))
        if found is None:
            return [lambda: defect]
        return [functools.partial(_links, measure, defect) for measure in found]

    def optimising(self, solve: WholeFit) -> Callable[[], Optimised | None]:
        """Return what fits the whole graph, in any thread, while the map changes; None if that fails."""
        fit = _guarded(lambda: self.live_map.optimising(solve))
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
        elif isinstance(event, LinksMeasured):
            self.unmeasured.pop(event.keyframe, None)
        self.changes += not isinstance(event, _UNCHANGING)
        return outcomes, None


def _guarded(act: Callable[[], _T]) -> _T | None:
    """Return what *act* returns; None after a defect: what only looks must not end the owner."""
    try:
        return act()
    except MemoryError:
        raise
    except Exception:  # noqa: BLE001  whatever the defect is
        return None


def _links(measure: Callable[[], LinksMeasured], otherwise: LinksMeasured) -> LinksMeasured:
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
    change = [OwnerChanged(owner=owner, epoch=epoch)]
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
