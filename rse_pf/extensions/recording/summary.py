"""Say by the summary of a finished file which of its chunks are worth reading.

A file that was cut off, or is still being written, has no summary and is read as a whole.  A summary may come
from a stranger, too: one that lies hides messages of its own file, and nothing else.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

__all__ = ["ChunkPlan", "Wanted", "plan_of", "robot_of"]

_MAX_RECORD_BYTES = 64 << 20
_DAMAGE = (struct.error, ValueError, OverflowError, KeyError, OSError)
"""What the library raises for records that are no records, beside its own errors."""


class Wanted(NamedTuple):
    """Which messages are asked for: those of one robot (a pseudonym), and of a span of Unix time, ns.

    ``robot`` is "" for all.
    """

    robot: str = ""
    begin_ns: int = 0
    end_ns: int = (1 << 63) - 1


class ChunkPlan(NamedTuple):
    """What a summary tells: the channels by number (topic, metadata), and which chunks are read, in order."""

    channels: Mapping[int, tuple[str, dict[str, str]]]
    is_read: list[bool]


def plan_of(
    path: Path, wanted: Wanted, robot_of_channel: Callable[[str, dict[str, str]], str | None]
) -> ChunkPlan | None:
    """Return what has to be read of a file, None if its summary does not say.

    Args:
        path: Of a recording.
        wanted: Which messages.
        robot_of_channel: Returns the pseudonym of a channel's topic and metadata, None for other channels.
    """
    summary = _summary(path)
    if summary is None:
        return None
    channels = {
        number: (channel.topic, dict(channel.metadata)) for number, channel in summary.channels.items()
    }
    robots = {number: robot_of_channel(*channel) for number, channel in channels.items()}
    of_robot = {
        number
        for number, robot in robots.items()
        if robot is not None and (robot == wanted.robot or not wanted.robot)
    }
    chunks = sorted(summary.chunk_indexes, key=lambda each: each.chunk_start_offset)
    return ChunkPlan(
        channels,
        [
            chunk.message_end_time >= wanted.begin_ns
            and chunk.message_start_time <= wanted.end_ns
            and not of_robot.isdisjoint(chunk.message_index_offsets)
            for chunk in chunks
        ],
    )


def robot_of(path: Path, topic: str) -> str | None:
    """Return the pseudonym of the robot whose channel is *topic*, None if the summary does not know it."""
    summary = _summary(path)
    channels = () if summary is None else summary.channels.values()
    return next((channel.metadata.get("robot") for channel in channels if channel.topic == topic), None)


def _summary(path: Path) -> Any:
    """Return the library's summary of a file, None if it has none."""
    from mcap.exceptions import McapError
    from mcap.reader import SeekingReader

    try:
        with path.open("rb") as file:
            summary = SeekingReader(file, record_size_limit=_MAX_RECORD_BYTES).get_summary()
    except (McapError, *_DAMAGE):
        return None
    return summary if summary is not None and summary.chunk_indexes else None
