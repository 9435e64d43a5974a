"""The demo with --live: what each robot records, and how the parent fetches the map at the end.

Figures are computed from these records by `rse_pf.extensions.experiments.results.live_error`.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from client_sdk.frontend import TrackedFrame
from client_sdk.live import LiveMapper
from client_sdk.trajectory import Trajectory, write_trajectory
from client_sdk.transfer.data_client import DataClient
from rse_pf.config import SessionSettings
from rse_pf.errors import RsePfError
from rse_pf.extensions.experiments.results.live_error import LIVE_MAP, LIVE_RECORDS, TRUTH

__all__ = ["LIVE_NAME", "LiveRecorder", "fetch_live_map", "show_live_map"]

LIVE_NAME = "demo"
"""Of the live map."""
_PUBLISH_S = 60.0


class LiveRecorder:
    """The records of one robot in a live map; times are seconds since the start of all robots."""

    def __init__(self, mapper: LiveMapper, now: Callable[[], float], began: float) -> None:
        """Record nothing yet; *now* is the clock of *mapper*, and *began* its reading at the start."""
        self._mapper, self._now, self._began = mapper, now, began
        self._lines: list[dict[str, Any]] = []
        self._listening: asyncio.Task[None]

    def start(self) -> LiveRecorder:
        """Begin to record corrections; return this object."""
        self._listening = asyncio.create_task(self._listen())
        return self

    def frame(self, done: TrackedFrame) -> None:
        """Record a frame with its poses as they were given out."""
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

    async def finish(self, folder: Path, truth: Trajectory | None) -> None:
        """Write the records, and the truth beside them, after the robot has left the map."""
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
        if truth is not None:
            await asyncio.to_thread(write_trajectory, folder / TRUTH, truth)

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
    """Publish the live map, and keep the version in *folder*; return why there is none, if so."""
    from client_sdk import connect

    try:
        async with connect(url, token=token, settings=session) as operator:
            answer = await operator.call("live-publish", {"map": LIVE_NAME}, deadline_s=_PUBLISH_S)
        await asyncio.to_thread(_download, url, token, str(answer.reply["version"]), folder)
    except RsePfError as error:
        return f"{error.code}: {error.message}"
    return ""


async def show_live_map(url: str, token: str, session: SessionSettings) -> dict[str, Any]:
    """Return ``digest``, keyframes and log ``position`` of the map; or the ``trouble``."""
    from client_sdk import connect

    try:
        async with connect(url, token=token, settings=session) as operator:
            answer = await operator.call("live-show", {"map": LIVE_NAME}, deadline_s=_PUBLISH_S)
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
