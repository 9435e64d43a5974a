"""The bytes of keyframes, in parts that do not change: so that a snapshot of a large map writes what is new.

A part holds the bytes and place vectors of up to 128 keyframes that came after each other, and is named by
its content.  A part that is full is kept as it is while at least half of its keyframes keep their bytes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

import msgspec
import numpy as np

from rse_pf.errors import BadRequest, message_of
from rse_pf.live_map.graph import Graph
from rse_pf.slam.place_recognition import PLACE_VECTOR_SIZE, PlaceIndex

__all__ = ["FeatureParts", "SnapshotParts"]

_KEYFRAMES = 128
_Row = tuple[int, bytes, bytes]


@dataclass(frozen=True, slots=True, kw_only=True)
class SnapshotParts:
    """A snapshot: ``head`` and the parts that it needs, by name; those that are stored already are None."""

    head: bytes
    parts: dict[str, bytes | None]


class FeatureParts:
    """The parts that were made of one map: name and keyframes by number; not part of the map's state."""

    def __init__(self) -> None:
        self._full: dict[int, tuple[str, frozenset[int]]] = {}

    def encode(self, graph: Graph, places: PlaceIndex, known: Collection[str]) -> SnapshotParts:
        """Return the map as parts; those whose names are *known* are not made again."""
        names: list[str] = []
        parts: dict[str, bytes | None] = {}
        held = graph.held
        for number in range(-(-len(graph) // _KEYFRAMES)):
            begin = number * _KEYFRAMES
            ids = (begin + np.flatnonzero(held[begin : begin + _KEYFRAMES])).tolist()
            name, members = self._full.get(number, ("", frozenset[int]()))
            if name in known and members.issuperset(ids) and 2 * len(ids) >= len(members):
                data = None
            else:
                data = msgspec.msgpack.encode([_row(graph, places, i) for i in ids])
                name = hashlib.sha256(data).hexdigest()
                if begin + _KEYFRAMES <= len(graph):
                    self._full[number] = name, frozenset(ids)
            names.append(name)
            parts[name] = data
        extra = {"parts": msgspec.msgpack.encode(names), "held": np.packbits(held).tobytes()}
        return SnapshotParts(head=graph.encode(extra, with_data=False), parts=parts)

    def forget(self, keyframes: Iterable[int]) -> None:
        """Make the parts of *keyframes* anew: what a robot said must go."""
        for number in {i // _KEYFRAMES for i in keyframes}:
            self._full.pop(number, None)

    @classmethod
    def decode(cls, head: bytes, part: Callable[[str], bytes]) -> tuple[Graph, PlaceIndex, FeatureParts]:
        """Return the map whose parts *part* gives by name.

        Raises:
            BadRequest: The head or a part is damaged, or of another version.
        """
        graph, extra = Graph.decode(head)
        places, parts = PlaceIndex(), cls()
        try:
            names = msgspec.msgpack.decode(extra["parts"], type=list[str])
            bits = np.frombuffer(extra["held"], dtype=np.uint8)
            held = np.unpackbits(bits, count=len(graph)).astype(np.bool_)
            for number, name in enumerate(names):
                data = part(name)
                if hashlib.sha256(data).hexdigest() != name:
                    raise _damaged(f"part {number} is not what its name says")
                rows = msgspec.msgpack.decode(data, type=list[_Row])
                for i, keyframe, vector in rows:
                    if held[i]:
                        graph.set_data(i, keyframe)
                        places.add(i, np.frombuffer(vector, dtype="<f4", count=PLACE_VECTOR_SIZE))
                if (number + 1) * _KEYFRAMES <= len(graph):
                    parts._full[number] = name, frozenset(i for i, _, _ in rows)
        except (msgspec.MsgspecError, KeyError, IndexError, ValueError) as error:
            raise _damaged(message_of(error)) from error
        if not np.array_equal(graph.held, held):
            raise _damaged("a keyframe is missing")
        return graph, places, parts


def _row(graph: Graph, places: PlaceIndex, i: int) -> _Row:
    data = graph.keyframes[i].data
    assert data is not None
    return i, data, places.vector_of(i).astype("<f4").tobytes()


def _damaged(why: str) -> BadRequest:
    return BadRequest(f"the snapshot is damaged: {why}", hint="take the older one")
