"""Replay the log of a live map in a process of its own, and say what it holds.

The owners of maps compute with one thread of BLAS, so the replay does, too: with two threads the last bits of
the poses may differ, and with them the digest.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import msgspec

from rse_pf.backend.live_map.owner.lease import map_folder
from rse_pf.backend.live_map.owner.log import LiveLog, MapSnapshot
from rse_pf.backend.live_map.owner.state import LIVE_MAP, MapState
from rse_pf.errors import RsePfError, UsageError
from rse_pf.identity import DEFAULT_TENANT, shown_name
from rse_pf.live_map.events import KeyframeAdded, decode_events
from rse_pf.object_store import DirectoryStore
from rse_pf.one_thread import ONE_THREAD
from rse_pf.terminal import show, show_json

__all__ = ["LoggedMap", "main", "read_log"]

_MAP_NAME = "demo"
_DAMAGED = 3
"""Exit code of a process whose last line of output says why the log cannot be replayed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LoggedMap:
    """What the log of a map holds up to a position: its keyframes in order, and the digest of a replay."""

    keyframes: tuple[tuple[str, int, float], ...]
    """Name of the robot, number, and time stamp (seconds)."""
    epochs: int
    digest: str
    position: int


class _WholeLog(LiveLog):
    """A log that is read from its first entry."""

    def snapshots(self) -> Iterator[MapSnapshot]:
        """Yield none."""
        return iter(())


def read_log(objects: Path, position: int) -> LoggedMap:
    """Replay the log of the map of the demo in *objects* up to *position*; raises UsageError."""
    command = [sys.executable, "-m", "rse_pf.experiments.results.log_replay", str(objects), str(position)]
    done = subprocess.run(
        command, env={**os.environ, **ONE_THREAD}, stdout=subprocess.PIPE, check=False
    )  # fmt: skip
    if done.returncode == 0:
        return msgspec.json.decode(done.stdout, type=LoggedMap)
    cause = done.stdout.decode().strip() if done.returncode == _DAMAGED else f"exit code {done.returncode}"
    raise UsageError(f"cannot replay the log in {objects}: {cause}", hint="run it again")


def main() -> int:
    """Replay the log that the arguments name, and print what it holds as JSON."""
    objects, position = Path(sys.argv[1]), int(sys.argv[2])
    try:
        logged = _replay(objects, position)
    except RsePfError as error:
        show(error.message)
        return _DAMAGED
    show_json(asdict(logged))
    return 0


def _replay(objects: Path, position: int) -> LoggedMap:
    folder = map_folder(DEFAULT_TENANT, _MAP_NAME)
    log = _WholeLog(DirectoryStore(objects), folder, owner="", epoch=0)
    state = MapState(LIVE_MAP.empty(), 0)
    keyframes: list[tuple[str, int, float]] = []
    epochs = set()
    for entry in log.entries():
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


if __name__ == "__main__":
    sys.exit(main())
