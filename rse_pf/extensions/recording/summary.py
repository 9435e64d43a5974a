"""Select the chunks of a finished file that have to be read, by the summary at its end.

A file that was truncated, or is still being written, has no summary and is read as a whole.  Summaries are
untrusted input: a false one only hides messages of its own file.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

__all__ = ["ChunkPlan", "Wanted", "plan_of", "robot_of"]

_MAX_RECORD_BYTES = 64 << 20  # largest MCAP record that is read: bounds the memory for a malformed file
_DAMAGE = (struct.error, ValueError, OverflowError, KeyError, OSError)
"""Exceptions that the library `mcap` raises for malformed records, in addition to McapError."""


class Wanted(NamedTuple):
    """A selection of messages: those of one robot in a span of time.

    ``robot`` is the pseudonym of the robot, "" for all robots; ``begin_ns`` and ``end_ns`` are Unix times.
    """

    robot: str = ""
    begin_ns: int = 0
    end_ns: int = (1 << 63) - 1


class ChunkPlan(NamedTuple):
    """Which parts of a file are read.

    ``channels`` are topic and metadata of all channels of the file by number; ``is_read`` says for each
    chunk, in the order of the file, whether it holds selected messages.
    """

    channels: Mapping[int, tuple[str, dict[str, str]]]
    is_read: list[bool]


def plan_of(
    path: Path, wanted: Wanted, robot_of_channel: Callable[[str, dict[str, str]], str | None]
) -> ChunkPlan | None:
    """Return which chunks of a file hold messages that *wanted* selects; None if it has no valid summary.

    Args:
        path: Path of the file.
        wanted: The selected messages.
        robot_of_channel: Returns the pseudonym of the robot of a channel from its topic and metadata, None
            for a channel that belongs to no robot.
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
    """Return the pseudonym of the robot whose channel is *topic*; None if the summary has no such channel."""
    summary = _summary(path)
    channels = () if summary is None else summary.channels.values()
    return next((channel.metadata.get("robot") for channel in channels if channel.topic == topic), None)


def _summary(path: Path) -> Any:
    """Return the summary of a file as `mcap` reads it; None if it is missing, malformed or without chunks."""
    from mcap.exceptions import McapError
    from mcap.reader import SeekingReader

    try:
        with path.open("rb") as file:
            summary = SeekingReader(file, record_size_limit=_MAX_RECORD_BYTES).get_summary()
    except (McapError, *_DAMAGE):
        return None
    return summary if summary is not None and summary.chunk_indexes else None
