"""The demo with --live: the records of each robot, and the download of the published map at the end.

`rse_pf.extensions.experiments.results.live_error` computes the figures from these records.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from client_sdk.frontend import TrackedFrame
from client_sdk.live import LiveMapper
from client_sdk.transfer.data_client import DataClient
from rse_pf.config import SessionSettings
from rse_pf.errors import RsePfError
from rse_pf.extensions.experiments.results.live_error import LIVE_MAP, LIVE_RECORDS

__all__ = ["LIVE_NAME", "LiveRecorder", "fetch_live_map", "show_live_map"]

LIVE_NAME = "demo"
"""Name of the demo's live map."""
# Deadline of the commands ``live-publish`` and ``live-show``, in seconds.
_PUBLISH_DEADLINE_S = 60.0


class LiveRecorder:
    """Collects the records of one robot in a live map; their times are seconds since the robots started."""

    def __init__(self, mapper: LiveMapper, now: Callable[[], float], began: float) -> None:
        """Describe the robot: *now* is the clock of *mapper* (s), *began* its time when the robots start."""
        self._mapper, self._now, self._began = mapper, now, began
        self._lines: list[dict[str, Any]] = []
        self._listening: asyncio.Task[None]

    def start(self) -> LiveRecorder:
        """Start the task that records the corrections of the map; return this object."""
        self._listening = asyncio.create_task(self._listen())
        return self

    def frame(self, done: TrackedFrame) -> None:
        """Record the tracked frame *done* with its poses in odometry frame and map, and the map's state."""
        self._lines.append(
            {
                "event": "frame",
                "t": self._since(self._now()),
                "stamp": done.frame.timestamp_s,
                "segment": done.segment,
                "T_odom": _numbers(done.T_world_camera),
                "T_map": _numbers(done.T_map_camera),
                "by": self._mapper.aligned_by,
                "owner": self._mapper.map_server,
                "state": self._mapper.state,
                "waiting": self._mapper.keyframes_waiting,
            }
        )

    async def finish(self, folder: Path) -> None:
        """Write the records to *folder*; this is called after the robot has left the map."""
        await self._listening
        self._lines.append({"event": "end", **self._mapper.report()["live"]})
        self._lines += [
            {
                "event": "keyframe",
                "number": sent_keyframe.number,
                "sent": self._since(sent_keyframe.sent_s),
                "kept": self._since(sent_keyframe.acknowledged_s),
            }
            for sent_keyframe in self._mapper.sent_keyframes
        ]
        text = "".join(json.dumps(line) + "\n" for line in self._lines)
        await asyncio.to_thread((folder / LIVE_RECORDS).write_text, text, encoding="utf-8")

    async def _listen(self) -> None:
        async for correction in self._mapper.corrections():
            self._lines.append(
                {
                    "event": "correction",
                    "t": self._since(self._now()),
                    "segment": correction.segment,
                    "T_map_odom": _numbers(correction.after),
                    "by": correction.by,
                    "reason": correction.reason,
                    "version": correction.version,
                    "cause": correction.cause,
                }
            )

    def _since(self, clock_s: float) -> float:
        return round(clock_s - self._began, 6)


async def fetch_live_map(url: str, token: str, folder: Path, session: SessionSettings) -> str:
    """Publish the live map and download the version to *folder*; return the error as text, empty if none."""
    from client_sdk import connect

    try:
        async with connect(url, token=token, settings=session) as operator:
            answer = await operator.call("live-publish", {"map": LIVE_NAME}, deadline_s=_PUBLISH_DEADLINE_S)
        await asyncio.to_thread(_download, url, token, str(answer.reply["version"]), folder)
    except RsePfError as error:
        return f"{error.code}: {error.message}"
    return ""


async def show_live_map(url: str, token: str, session: SessionSettings) -> dict[str, Any]:
    """Return digest, log position, number of keyframes, map server and epoch of the live map.

    After an error the only member is ``trouble``, with its code and message.
    """
    from client_sdk import connect

    try:
        async with connect(url, token=token, settings=session) as operator:
            answer = await operator.call("live-show", {"map": LIVE_NAME}, deadline_s=_PUBLISH_DEADLINE_S)
    except RsePfError as error:
        return {"trouble": f"{error.code}: {error.message}"}
    reply = answer.reply
    return {
        "digest": reply["digest"],
        "position": reply["version"],
        "keyframes": reply["keyframes"],
        "owner": reply["owner"],
        "epoch": reply["epoch"],
    }


def _download(url: str, token: str, version: str, folder: Path) -> None:
    data = DataClient(url, token)
    try:
        (folder / LIVE_MAP).write_bytes(data.download_map(LIVE_NAME, version))
    finally:
        data.close()


def _numbers(pose: Any) -> list[float] | None:
    return None if pose is None else [float(value) for value in pose.ravel()]
