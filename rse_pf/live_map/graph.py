"""The state of a live map: keyframes, segments of odometry, links, and how they are connected.

Explicit numbers only, in the order of the events: the same events, or a snapshot and the events after it,
give the same bytes.  Nothing here decides; `agreement` and `live_map` do.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import msgspec
import numpy as np
import numpy.typing as npt

from rse_pf.errors import BadRequest, message_of
from rse_pf.geometry import Array, scaled
from rse_pf.slam.consistency import StrongLink

__all__ = ["Graph", "LiveKeyframe", "LiveLink", "Segment", "variances_of"]

LinkState = Literal["open", "believed", "removed"]

_VERSION = 2
_MAX_WALK = 200.0
"""Steps of odometry beyond which two keyframes tell nothing about each other."""
_MAX_VISITED = 250
_MAX_REMOVED = 2000
_SCALES, _OBJECTS = "scales", "objects"
_MAX_GONE = 10_000
_CARRIED = 0xFFFF
"""Contradictions of the newest 16 keyframes count in the robot's next segment, too."""


_FLOOR: Array = np.diag([0.02**2] * 3 + [math.radians(0.7) ** 2] * 3)
"""Covariance of a relative pose at least: errors of depth and calibration are correlated."""


@dataclass(slots=True, eq=False)
class LiveKeyframe:
    """The row of a keyframe; ``data`` are its bytes, None when it was culled or forgotten.

    ``objects`` are the digests of what the robot stored beside it, also of a culled one.
    """

    robot: str
    segment: int
    number: int
    timestamp_s: float
    data: bytes | None
    objects: tuple[str, ...] = ()


@dataclass(slots=True, eq=False)
class Segment:
    """Keyframes of one robot in one odometry frame, by id, oldest first.

    ``told`` is the alignment that was last told, None while it has none; ``reason`` says why.
    """

    robot: str
    segment: int
    keyframes: list[int] = field(default_factory=list)
    component: int = 0
    told: Array | None = None
    covariance: Array = field(default_factory=lambda: _FLOOR.copy())
    reason: str = "no loop closure between its keyframes and the map is accepted yet"
    version: bool = False
    """Whether these are keyframes of the version that the map started from."""
    contradictions: int = 0
    """A bit for each of the last 32 keyframes with links within the component: whether all contradict it."""
    disbelieved: bool = False
    """Whether its links are no longer taken, since it kept contradicting itself."""
    is_metric: bool = True
    """Whether its odometry and its depths are in metres."""
    scale: float = 1.0
    """How long its unit is in that of its component: in metres where that is metric."""
    told_scale: float = 1.0
    """The scale that was last told with ``told``."""


@dataclass(slots=True, eq=False)
class LiveLink:
    """A measured relative pose of keyframes ``a`` and ``b``; ``a`` is the one that was measured.

    ``variances`` ``(6,)`` are of the twist (square metres, square radians); ``doubts`` counts the updates in
    a row in which the link contradicted the graph.  ``scale`` is the logarithm, with its variance, of how
    long the unit of *b* is in that of *a*, None between two in metres; lengths are metres if one of the two
    is, else in the unit of *a*.
    """

    a: int
    b: int
    T_a_b: Array
    information: Array
    inliers: int
    matches: int
    variances: Array
    fixed: bool = False
    state: LinkState = "open"
    doubts: int = 0
    scale: tuple[float, float] | None = None

    def weight(self, strong: StrongLink) -> float:
        """Return how much the link counts, within 0..1; those of a version count whole."""
        return 1.0 if self.fixed else strong.weight_of(self.inliers, self.matches)


class Graph:
    """All that a live map knows; `encode` and `decode` are a snapshot's content.

    Attributes:
        keyframes: By id.
        T: ``(n, 4, 4)``, pose of each keyframe in the frame of its component; `T_odom` that of its odometry.
        way: ``(n,)``, steps of odometry from the begin of its segment.
        of_segment: ``(n,)``, row of its segment, -1 when it was forgotten.
        held: ``(n,)``, whether its bytes are kept.
        links: By number, in the order in which they were measured; `open` are those not believed.
        equal_rooms_m: What joins robots must lie farther apart than this.
        removed: The newest links that were taken out, by number: who refuted them may be forgotten.
        smoothing: By robot, how many keyframes were smoothed because of it beyond what its own ones allow.
        lookalikes: Keyframes at places of which the map knows another one that looks the same.
        gone_objects: Robot and digest of the newest objects whose robot was forgotten.
    """

    def __init__(self) -> None:
        self.keyframes: list[LiveKeyframe] = []
        self.segments: list[Segment] = []
        self.links: dict[int, LiveLink] = {}
        self.open: list[int] = []
        self.removed: dict[int, LiveLink] = {}
        self.agreements: dict[tuple[int, int], bool] = {}
        self.next_link = 0
        self.root = -1
        self.events = 0
        self.next_numbers: dict[str, int] = {}
        self.newest: dict[str, int] = {}
        self.left: list[str] = []
        self.optimised_at = 0
        self.smoothing: dict[str, int] = {}
        self.lookalikes: set[int] = set()
        self.source = ""
        self.equal_rooms_m = 0.0
        self.gone_objects: list[tuple[str, str]] = []
        self._links_of: dict[int, list[int]] = {}
        self._size = 0
        self._T = np.empty((64, 4, 4))
        self._T_odom = np.empty((64, 4, 4))
        self._way = np.empty(64)
        self._of_segment = np.empty(64, dtype=np.int64)
        self._place = np.empty(64, dtype=np.int64)
        self._held = np.empty(64, dtype=np.bool_)

    def __len__(self) -> int:
        return self._size

    @property
    def T(self) -> Array:
        """``(n, 4, 4)``, pose of each keyframe in the frame of its component."""
        return self._T[: self._size]

    @property
    def T_odom(self) -> Array:
        """``(n, 4, 4)``, pose of each keyframe in the frame of its odometry."""
        return self._T_odom[: self._size]

    @property
    def way(self) -> Array:
        """``(n,)``, steps of odometry from the begin of the segment."""
        return self._way[: self._size]

    @property
    def of_segment(self) -> npt.NDArray[np.int64]:
        """``(n,)``, row of the segment; -1 when the keyframe was forgotten."""
        return self._of_segment[: self._size]

    @property
    def held(self) -> npt.NDArray[np.bool_]:
        """``(n,)``, whether the features are kept."""
        return self._held[: self._size]

    def is_metric(self, component: int) -> bool:
        """Return whether the lengths of a component are metres: a segment of it has some."""
        return any(
            each.component == component and each.is_metric and each.keyframes for each in self.segments
        )

    def segment_of(self, i: int) -> Segment:
        """Return the segment of keyframe *i*, which is not forgotten."""
        return self.segments[int(self._of_segment[i])]

    def unit_of(self, link: LiveLink) -> int:
        """Return the row of the segment in whose unit a link is, -1 if it is in metres."""
        a, b = self.segment_of(link.a), self.segment_of(link.b)
        return -1 if a.is_metric or b.is_metric else int(self._of_segment[link.a])

    def step_of(self, link: LiveLink) -> Array:
        """Return ``T_a_b`` of a link within one component, in the unit of that."""
        row = self.unit_of(link)
        return link.T_a_b if row < 0 else scaled(link.T_a_b, self.segments[row].scale)

    def odometry(self, ids: Sequence[int]) -> Array:
        """Return ``(n, 4, 4)`` poses in the frames of their odometry, in the unit of the component."""
        T = self.T_odom[np.asarray(ids, dtype=np.int64)]
        return scaled(T, np.array([self.segment_of(i).scale for i in ids])) if self.has_scales else T

    @property
    def has_scales(self) -> bool:
        """Whether the unit of a segment is unknown."""
        return not all(each.is_metric for each in self.segments)

    def add(self, keyframe: LiveKeyframe, row: int, T_odom: Array, T: Array, way: float) -> int:
        """Append a keyframe to segment *row*; return its id."""
        if self._size == len(self._way):
            for name in ("_T", "_T_odom", "_way", "_of_segment", "_place", "_held"):
                old = getattr(self, name)
                new = np.empty((2 * len(old), *old.shape[1:]), dtype=old.dtype)
                new[: self._size] = old[: self._size]
                setattr(self, name, new)
        i = self._size
        self._size += 1
        self.keyframes.append(keyframe)
        self._T[i], self._T_odom[i], self._way[i] = T, T_odom, way
        self._of_segment[i], self._place[i], self._held[i] = row, len(self.segments[row].keyframes), True
        self.segments[row].keyframes.append(i)
        return i

    def drop_data(self, i: int) -> None:
        """Forget what keyframe *i* saw; its pose and its links stay."""
        self.keyframes[i].data = None
        self._held[i] = False

    def set_data(self, i: int, data: bytes) -> None:
        """Give keyframe *i* of a snapshot its bytes."""
        self.keyframes[i].data = data
        self._held[i] = True

    def add_link(self, link: LiveLink) -> int:
        """Keep *link*; return its number."""
        number = self.next_link
        self.next_link += 1
        self.links[number] = link
        if link.state == "believed":
            self._connect(number, link)
        else:
            self.open.append(number)
        return number

    def believe(self, number: int) -> None:
        """Let an open link hold poses together."""
        link = self.links[number]
        link.state, link.doubts = "believed", 0
        self.open.remove(number)
        self._connect(number, link)

    def remove_link(self, number: int) -> None:
        """Take a link out, believed or not; the newest of those taken out are kept for `reopen`."""
        link = self.links.pop(number)
        if link.state == "believed":
            self._links_of[link.a].remove(number)
            self._links_of[link.b].remove(number)
        else:
            self.open.remove(number)
        link.state = "removed"
        self.removed[number] = link
        if len(self.removed) > _MAX_REMOVED:
            del self.removed[next(iter(self.removed))]

    def drop_oldest_open(self, most: int) -> None:
        """Take out the oldest links that are not believed, beyond the newest *most*."""
        surplus = len(self.open) - most
        if surplus > 0:
            for number in self.open[:surplus]:
                self.remove_link(number)
            self.forget_agreements()

    def find_segment(self, robot: str, number: int) -> Segment | None:
        """Return a robot's segment, None if there is none or nothing is left of it."""
        for each in self.segments:
            if (each.robot, each.segment) == (robot, number) and not each.version and each.keyframes:
                return each
        return None

    def segment_row(self, robot: str, number: int) -> int:
        """Return the row of a robot's segment; it begins if there is none."""
        newest = self.newest.get(robot)
        for row in range(len(self.segments)) if newest is None else (newest,):
            segment = self.segments[row]
            if (segment.robot, segment.segment) == (robot, number) and not segment.version:
                return row
        row = len(self.segments)
        segment = Segment(robot=robot, segment=number, component=row)
        own = [each for each in self.segments if each.robot == robot and not each.version]
        if own:
            segment.contradictions = own[-1].contradictions & _CARRIED
        self.segments.append(segment)
        return row

    def reopen(self) -> None:
        """Take all that was believed of links that are not believed back: each has to be judged again."""
        for number, link in self.removed.items():
            link.state, link.doubts = "open", 0
            self.links[number] = link
        self.open = sorted([*self.open, *self.removed])
        self.removed = {}
        self.lookalikes = set()
        self.agreements = {}

    def forget(self, robot: str) -> list[int]:
        """Take out the keyframes of *robot* with their links; return their ids."""
        gone = [
            i
            for segment in self.segments
            if segment.robot == robot and not segment.version
            for i in segment.keyframes
        ]
        members = set(gone)
        for number in [n for n, link in self.links.items() if link.a in members or link.b in members]:
            self.remove_link(number)
        self.removed = {
            number: link for number, link in self.removed.items()
            if link.a not in members and link.b not in members
        }  # fmt: skip
        for segment in self.segments:
            if segment.robot == robot and not segment.version:
                segment.keyframes = []
                segment.told = None
                segment.contradictions, segment.disbelieved = 0, False
        self.smoothing.pop(robot, None)
        for i in gone:
            self.drop_data(i)
            self.gone_objects += [(robot, digest) for digest in self.keyframes[i].objects]
            self.keyframes[i].objects = ()
            self._of_segment[i] = -1
        self.gone_objects = self.gone_objects[-_MAX_GONE:]
        return gone

    def disbelieve(self, row: int) -> None:
        """Take out the links of segment *row* for good; its keyframes stay."""
        self.segments[row].disbelieved = True
        for number in [number for number, link in self.links.items() if self._is_at(row, link)]:
            self.remove_link(number)
        self.removed = {number: link for number, link in self.removed.items() if not self._is_at(row, link)}
        if self.root == row:
            component = self.segments[row].component
            beside = (
                other for other, each in enumerate(self.segments)
                if other != row and each.component == component and each.keyframes and each.is_metric
            )  # fmt: skip
            self.root = next(beside, row)
        self.connect()

    def _is_at(self, row: int, link: LiveLink) -> bool:
        return bool(self._of_segment[link.a] == row or self._of_segment[link.b] == row)

    def anchor(self, row: int) -> int:
        """Return the keyframe that defines the frame of a segment's component, -1 if it is gone."""
        root = self.segments[self.root].component if self.root >= 0 else -1
        component = self.segments[row].component
        ids = self.segments[self.root if component == root else component].keyframes
        return ids[0] if ids else -1

    def anchors(self) -> set[int]:
        """Return the keyframes that define the frames of all components."""
        return {self.anchor(row) for row in range(len(self.segments))}

    def forget_agreements(self) -> None:
        """Drop what is known of links that are no longer open."""
        still = set(self.open)
        self.agreements = {
            pair: agrees for pair, agrees in self.agreements.items() if pair[0] in still and pair[1] in still
        }

    def links_at(self, i: int) -> list[int]:
        """Return the numbers of the believed links of keyframe *i*."""
        return self._links_of.get(i, [])

    def neighbours(self, i: int) -> Iterator[tuple[int, float]]:
        """Yield the keyframes that odometry or a believed link connects with *i*, and how far they are.

        A link counts as one step.
        """
        row = self._of_segment[i]
        segment = self.segments[row]
        if not segment.version:
            place = int(self._place[i])
            for near in (place - 1, place + 1):
                if 0 <= near < len(segment.keyframes):
                    other = segment.keyframes[near]
                    yield other, abs(float(self._way[other] - self._way[i]))
        for number in self._links_of.get(i, []):
            link = self.links[number]
            yield (link.b if link.a == i else link.a), 1.0

    def steps_at(self, i: int) -> list[tuple[int, int]]:
        """Return the pairs of consecutive keyframes of odometry that *i* belongs to."""
        segment = self.segments[self._of_segment[i]]
        if segment.version:
            return []
        place, ids = int(self._place[i]), segment.keyframes
        return [(ids[near], ids[near + 1]) for near in (place - 1, place) if 0 <= near < len(ids) - 1]

    def next_in_segment(self, i: int) -> int:
        """Return the keyframe after *i* in its segment, -1 if it is the last."""
        ids, place = self.segments[self._of_segment[i]].keyframes, int(self._place[i])
        return int(ids[place + 1]) if place + 1 < len(ids) else -1

    def walks(self, start: int, targets: Iterable[int]) -> dict[int, float]:
        """Return how many steps of odometry each target is away from *start*, along the shortest path.

        The search is bounded; a target beyond it is as far as the farthest that was seen, or farther.
        """
        wanted = set(targets)
        found: dict[int, float] = {}
        done: set[int] = set()
        heap = [(0.0, start)]
        far = 0.0
        while heap and len(found) < len(wanted) and len(done) < _MAX_VISITED:
            far, i = heapq.heappop(heap)
            if i in done:
                continue
            done.add(i)
            if i in wanted:
                found[i] = far
            for other, length in self.neighbours(i):
                if other not in done:
                    heapq.heappush(heap, (far + length, other))
        for i in wanted - found.keys():
            apart = abs(float(self._way[i] - self._way[start]))
            is_one = self._of_segment[i] == self._of_segment[start]
            found[i] = min(apart, _MAX_WALK) if is_one else max(far, _MAX_WALK)
        return found

    def component_of(self, i: int) -> int:
        """Return the component of keyframe *i*: the row of its first segment."""
        return self.segments[int(self._of_segment[i])].component

    def connect(self) -> None:
        """Compute the components anew: of segments, connected by believed links."""
        root = list(range(len(self.segments)))

        def find(row: int) -> int:
            while root[row] != row:
                root[row] = root[root[row]]
                row = root[row]
            return row

        for link in self.links.values():
            if link.state == "believed":
                one, other = find(int(self._of_segment[link.a])), find(int(self._of_segment[link.b]))
                root[max(one, other)] = min(one, other)
        for row, segment in enumerate(self.segments):
            segment.component = find(row)

    def bridges(self) -> dict[tuple[int, int], list[int]]:
        """Return the numbers of believed links by the pair of segments that they connect."""
        found: dict[tuple[int, int], list[int]] = {}
        for number, link in self.links.items():
            if link.state == "believed":
                one, other = int(self._of_segment[link.a]), int(self._of_segment[link.b])
                found.setdefault((min(one, other), max(one, other)), []).append(number)
        return found

    def _connect(self, number: int, link: LiveLink) -> None:
        self._links_of.setdefault(link.a, []).append(number)
        self._links_of.setdefault(link.b, []).append(number)

    def encode(self, extra: dict[str, bytes], with_data: bool = True) -> bytes:
        """Return everything as bytes, with *extra* byte strings beside it."""
        believed = {str(i): numbers for i, numbers in sorted(self._links_of.items()) if numbers}
        if self.has_scales:  # a map in metres has the bytes that it had before there were others
            extra = {**extra, _SCALES: self._encode_scales()}
        objects = [(i, each.objects) for i, each in enumerate(self.keyframes) if each.objects]
        if objects or self.gone_objects:
            packed_objects = _PackedObjects(keyframes=objects, gone=self.gone_objects)
            extra = {**extra, _OBJECTS: msgspec.msgpack.encode(packed_objects)}
        packed = _Packed(
            version=_VERSION,
            keyframes=[
                (k.robot, k.segment, k.number, k.timestamp_s, k.data if with_data else None)
                for k in self.keyframes
            ],
            segments=[
                (
                    s.robot, s.segment, s.keyframes, s.component,
                    None if s.told is None else s.told.tobytes(), s.covariance.tobytes(), s.reason, s.version,
                )
                for s in self.segments
            ],
            links=[_packed_link(number, link) for number, link in self.links.items()],
            removed=[_packed_link(number, link) for number, link in self.removed.items()],
            smoothing=list(self.smoothing.items()),
            trust=[(each.contradictions, each.disbelieved) for each in self.segments],
            open=self.open,
            agreements=[(*pair, agrees) for pair, agrees in self.agreements.items()],
            numbers=(self.next_link, self.root, self.events, self.optimised_at),
            next_numbers=list(self.next_numbers.items()),
            newest=list(self.newest.items()),
            left=self.left,
            source=self.source,
            equal_rooms_m=self.equal_rooms_m,
            lookalikes=sorted(self.lookalikes),
            links_of=list(believed.items()),
            arrays=[
                np.ascontiguousarray(each).tobytes()
                for each in (self.T, self.T_odom, self.way, self.of_segment, self._place[: self._size])
            ],
            extra=list(extra.items()),
        )  # fmt: skip
        return msgspec.msgpack.encode(packed)

    @classmethod
    def decode(cls, data: bytes) -> tuple[Graph, dict[str, bytes]]:
        """Return the graph and the extra bytes of a snapshot.

        Raises:
            BadRequest: The snapshot is damaged, or of another version.
        """
        try:
            version = msgspec.msgpack.decode(data, type=_Versioned).version
            if version != _VERSION:
                raise BadRequest(
                    f"the snapshot is of version {version}, not {_VERSION}",
                    hint="publish the map with the release that wrote it: rse-pf map publish MAP; "
                    "then start from that version: rse-pf map live start MAP --from MAP",
                )
            packed = msgspec.msgpack.decode(data, type=_Packed)
        except (msgspec.MsgspecError, ValueError) as error:
            raise BadRequest(
                f"the snapshot is damaged: {message_of(error)}", hint="take the older one"
            ) from error
        graph = cls()
        n = graph._size = len(packed.keyframes)
        capacity = max(64, n)
        kinds = (("<f8", (4, 4)), ("<f8", (4, 4)), ("<f8", ()), ("<i8", ()), ("<i8", ()))
        names = ("_T", "_T_odom", "_way", "_of_segment", "_place")
        for name, (kind, shape), raw in zip(names, kinds, packed.arrays, strict=True):
            array = np.empty((capacity, *shape), dtype=np.dtype(kind))
            array[:n] = np.frombuffer(raw, dtype=np.dtype(kind)).reshape(n, *shape)
            setattr(graph, name, array)
        graph._held = np.zeros(capacity, dtype=np.bool_)
        graph.keyframes = [LiveKeyframe(*row[:4], data=None) for row in packed.keyframes]
        for i, row in enumerate(packed.keyframes):
            if row[-1] is not None:
                graph.set_data(i, row[-1])
        graph.segments = [
            Segment(
                robot=robot, segment=segment, keyframes=keyframes, component=component,
                told=None if told is None else _matrix(told, 4), covariance=_matrix(covariance, 6),
                reason=reason, version=version,
            )
            for robot, segment, keyframes, component, told, covariance, reason, version in packed.segments
        ]  # fmt: skip
        for segment, (contradictions, disbelieved) in zip(graph.segments, packed.trust, strict=False):
            segment.contradictions, segment.disbelieved = contradictions, disbelieved
        graph.links, graph.removed = _links_of(packed.links), _links_of(packed.removed)
        graph.open = packed.open
        graph.agreements = {(i, j): agrees for i, j, agrees in packed.agreements}
        graph.next_link, graph.root, graph.events, graph.optimised_at = packed.numbers
        graph.next_numbers = dict(packed.next_numbers)
        graph.newest, graph.smoothing = dict(packed.newest), dict(packed.smoothing)
        graph.left, graph.source = packed.left, packed.source
        graph.equal_rooms_m = packed.equal_rooms_m
        graph.lookalikes = set(packed.lookalikes)
        graph._links_of = {int(i): numbers for i, numbers in packed.links_of}
        extra = dict(packed.extra)
        graph._take_scales(extra.pop(_SCALES, b""))
        graph._take_objects(extra.pop(_OBJECTS, b""))
        return graph, extra

    def _encode_scales(self) -> bytes:
        links = {**self.links, **self.removed}
        return msgspec.msgpack.encode(
            _PackedScales(
                segments=[
                    (row, each.scale, each.told_scale)
                    for row, each in enumerate(self.segments) if not each.is_metric
                ],
                links=[(n, *each.scale) for n, each in sorted(links.items()) if each.scale is not None],
            )
        )  # fmt: skip

    def _take_scales(self, data: bytes) -> None:
        """Take what `_encode_scales` encoded; raises BadRequest."""
        if not data:
            return
        try:
            packed = msgspec.msgpack.decode(data, type=_PackedScales)
            for row, scale, told_scale in packed.segments:
                segment = self.segments[row]
                segment.is_metric, segment.scale, segment.told_scale = False, scale, told_scale
            for number, log_ratio, variance in packed.links:
                link = self.links[number] if number in self.links else self.removed[number]
                link.scale = log_ratio, variance
        except (msgspec.MsgspecError, LookupError) as error:
            raise BadRequest(
                f"the snapshot is damaged: {message_of(error)}", hint="take the older one"
            ) from error

    def _take_objects(self, data: bytes) -> None:
        """Take the objects of keyframes of a snapshot; raises BadRequest."""
        if not data:
            return
        try:
            packed = msgspec.msgpack.decode(data, type=_PackedObjects)
            for i, objects in packed.keyframes:
                self.keyframes[i].objects = objects
        except (msgspec.MsgspecError, LookupError) as error:
            raise BadRequest(
                f"the snapshot is damaged: {message_of(error)}", hint="take the older one"
            ) from error
        self.gone_objects = packed.gone


_PackedLink = tuple[int, int, int, bytes, bytes, int, int, bool, LinkState, int]


class _Versioned(msgspec.Struct):
    version: int


class _Packed(msgspec.Struct, kw_only=True):
    version: int
    keyframes: list[tuple[str, int, int, float, bytes | None]]
    segments: list[tuple[str, int, list[int], int, bytes | None, bytes, str, bool]]
    links: list[_PackedLink]
    open: list[int]
    agreements: list[tuple[int, int, bool]]
    numbers: tuple[int, int, int, int]
    next_numbers: list[tuple[str, int]]
    newest: list[tuple[str, int]]
    left: list[str]
    source: str
    lookalikes: list[int]
    links_of: list[tuple[str, list[int]]]
    arrays: list[bytes]
    extra: list[tuple[str, bytes]]
    equal_rooms_m: float = 0.0
    removed: list[_PackedLink] = []
    trust: list[tuple[int, bool]] = []
    smoothing: list[tuple[str, int]] = []


class _PackedScales(msgspec.Struct, kw_only=True):
    """What segments without metres add to a snapshot; the scales of links are logarithms with variances."""

    segments: list[tuple[int, float, float]]
    links: list[tuple[int, float, float]]


class _PackedObjects(msgspec.Struct, kw_only=True):
    """What objects of robots add to a snapshot: digests by id of the keyframe, and those to be deleted."""

    keyframes: list[tuple[int, tuple[str, ...]]]
    gone: list[tuple[str, str]]


def _packed_link(number: int, link: LiveLink) -> _PackedLink:
    return (
        number, link.a, link.b, link.T_a_b.tobytes(), link.information.tobytes(), link.inliers, link.matches,
        link.fixed, link.state, link.doubts,
    )  # fmt: skip


def _links_of(packed: list[_PackedLink]) -> dict[int, LiveLink]:
    stack = np.frombuffer(b"".join(each[4] for each in packed), dtype="<f8").reshape(-1, 6, 6)
    links = {}
    for each, information, variances in zip(packed, stack, variances_of(stack), strict=True):
        number, a, b, step, _, inliers, matches, fixed, state, doubts = each
        links[number] = LiveLink(
            a=a, b=b, T_a_b=_matrix(step, 4), information=information, inliers=inliers, matches=matches,
            variances=variances, fixed=fixed, state=state, doubts=doubts,
        )  # fmt: skip
    return links


def variances_of(information: Array) -> Array:
    """Return the ``(m, 6)`` variances of twists with the ``(m, 6, 6)`` *information*."""
    variances: Array = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)
    return variances


def _matrix(raw: bytes, n: int) -> Array:
    matrix: Array = np.frombuffer(raw, dtype="<f8").reshape(n, n)
    return matrix
