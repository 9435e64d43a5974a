"""Replay the log of a live map in a child process, and return the keyframes and the digest of the map.

Map servers compute with one thread of BLAS, and so does the child process: with two threads the last bits of
the poses, and thus the digest, may differ.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec

from rse_pf.errors import RsePfError, UsageError
from rse_pf.identity import DEFAULT_TENANT, shown_name
from rse_pf.live_map.events import KeyframeAdded, decode_events
from rse_pf.processes.ipc import encode_message, receive
from rse_pf.processes.start import ChildPlan, how_ended, start_child
from rse_pf.server.live_map.lease import map_folder
from rse_pf.server.live_map.map_server.environment import LIVE_MAP
from rse_pf.server.live_map.map_server.log import LiveLog, MapSnapshot
from rse_pf.server.live_map.map_server.state import MapState
from rse_pf.storage.object_store import DirectoryStore

__all__ = ["LoggedMap", "read_log", "run"]

# Name of the demo's live map.
_MAP_NAME = "demo"
# Time after which a child process that has answered and does not exit is killed, in seconds.
_EXIT_TIMEOUT_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedMap:
    """The content of a map's log up to ``position``: keyframes in order, and the replayed map's digest.

    ``epochs`` is the number of map servers that wrote entries.
    """

    keyframes: tuple[tuple[str, int, float], ...]
    """Name of the robot, number, and time stamp (s) of each keyframe, in the order of the log."""
    epochs: int
    digest: str
    position: int


class _WholeLog(LiveLog):
    """A log that is read from its first entry, because it claims to have no snapshots."""

    def read_snapshots(self) -> Iterator[MapSnapshot]:
        """Yield no snapshot."""
        return iter(())


def read_log(objects: Path, position: int) -> LoggedMap:
    """Replay the log of the demo's live map in the object store *objects* up to entry *position*.

    Raises:
        UsageError: The log cannot be read, or the child process exited.
    """
    child = start_child(ChildPlan(target=f"{__name__}:run", name="rse-pf replay"))
    child.say([str(objects), position])
    answer = receive(child.connection)
    code = child.end(_EXIT_TIMEOUT_S)
    if isinstance(answer, dict):
        return msgspec.convert(answer, LoggedMap)
    raise UsageError(f"cannot replay the log in {objects}: {answer or how_ended(code)}", hint="run it again")


def run(parent: socket.socket) -> None:
    """Replay the log whose store and position the *parent* sends, and answer with its content or the error.

    This is the entry point of the child process.
    """
    objects, position = receive(parent)
    try:
        answer: Any = asdict(_replay(Path(objects), position))
    except RsePfError as error:
        answer = error.message
    parent.sendall(encode_message(answer))


def _replay(objects: Path, position: int) -> LoggedMap:
    folder = map_folder(DEFAULT_TENANT, _MAP_NAME)
    log = _WholeLog(DirectoryStore(objects), folder, owner="", epoch=0)
    state = MapState(LIVE_MAP.empty(), 0)
    keyframes: list[tuple[str, int, float]] = []
    epochs = set()
    for entry in log.read_entries():
        events = decode_events(entry.events)
        epochs.add(entry.epoch)
        keyframes += [
            (shown_name(event.robot), event.number, event.keyframe.timestamp_s)
            for event in events
            if isinstance(event, KeyframeAdded)
        ]
        state.apply(log.position, events)
        if log.position == position:
            break
    return LoggedMap(
        keyframes=tuple(keyframes), epochs=len(epochs), digest=state.digest(), position=log.position
    )
