"""Pass on what the fleet page knows to Foxglove, as channels of its WebSocket server on loopback.

It subscribes to the same `Hub` as a browser window.  It serves viewers that name no key: all programs of this
machine can read it, so it is off by default, and it takes no orders.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import re
import signal
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rse_pf.errors import MissingExtra, RsePfError, UsageError
from rse_pf.fleet_page.feeds.live_feed import LIVE, LiveFeed
from rse_pf.fleet_page.feeds.platform_feed import LocalFeed
from rse_pf.fleet_page.hub import Hub
from rse_pf.geometry import to_quaternion
from rse_pf.linux import die_with_parent, set_process_name
from rse_pf.recording.file_format import JSON_SCHEMA_ENCODING, POSE_SCHEMA, SCHEMAS, encode_json
from rse_pf.terminal import show_error, show_json

__all__ = ["ExportedMessage", "export_messages", "serve_foxglove"]

_HOST = "127.0.0.1"
_TOPICS = frozenset(("fleet", "event", "pose", "robots", "maps"))
_CHANNELS = {"fleet": "/fleet", "event": "/events", "pose": "/commands", "robots": "/robots"}
_NOT_FOR_A_TOPIC = re.compile(r"[^A-Za-z0-9_.-]")
_PREFIX = b"data: "
_ANY_OBJECT = b'{"type":"object"}'
_MAX_CHANNELS = 512


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportedMessage:
    """A message for a channel: its topic, the name of its schema, and what it says."""

    channel: str
    schema: str
    value: Mapping[str, Any]


def export_messages(topic: str, key: str, value: Any, *, now_s: float) -> Iterator[ExportedMessage]:
    """Yield what Foxglove is told of one value or row of the hub; *now_s* stands in for a missing time."""
    if topic in _CHANNELS:
        row = value if isinstance(value, Mapping) else {"rows": value}
        yield ExportedMessage(channel=_CHANNELS[topic], schema=f"rse_pf.{topic.capitalize()}", value=row)
    elif topic.startswith(LIVE) and isinstance(value, Mapping):
        name = _topic_part(topic.removeprefix(LIVE))
        if value.get("kind") == "pose" and len(value.get("T_map_camera") or ()) == 16:
            pose = _pose(value, frame=name, now_s=now_s)
            channel = f"/live/{name}/{_topic_part(str(value.get('robot', '')))}"
            yield ExportedMessage(channel=channel, schema=POSE_SCHEMA, value=pose)
        elif not key.startswith("path/"):
            yield ExportedMessage(channel=f"/live/{name}", schema="rse_pf.LiveMap", value=value)


def serve_foxglove(folder: Path, *, port: int) -> int:
    """Export the platform in *folder* until a signal; return the exit code.

    Raises:
        MissingExtra: ``foxglove-sdk`` is not installed.
        UsageError: The port is taken.
    """
    try:
        import foxglove
    except ImportError as error:
        raise MissingExtra("foxglove-sdk", "foxglove") from error
    try:
        server = foxglove.start_server(name=f"RSE-PF {folder.name}", host=_HOST, port=port)
    except (OSError, RuntimeError, ValueError) as error:
        raise UsageError(
            f"port {port} cannot be used for Foxglove", hint="name another: --foxglove P"
        ) from error
    show_json({"url": f"ws://{_HOST}:{server.port}"})
    try:
        asyncio.run(_export(folder, _Channels(foxglove)))
    finally:
        server.stop()
    return 0


class _Channels:
    """The channels of the server, made when they are first written."""

    def __init__(self, foxglove: Any) -> None:
        self._foxglove = foxglove
        self._channels: dict[str, Any] = {}

    def write(self, message: ExportedMessage) -> None:
        channel = self._channels.get(message.channel)
        if channel is None:
            if len(self._channels) >= _MAX_CHANNELS:
                return
            schema = self._foxglove.Schema(
                name=message.schema,
                encoding=JSON_SCHEMA_ENCODING,
                data=SCHEMAS.get(message.schema, _ANY_OBJECT),
            )
            channel = self._foxglove.Channel(message.channel, schema=schema, message_encoding="json")
            self._channels[message.channel] = channel
        channel.log(encode_json(message.value))


async def _export(folder: Path, channels: _Channels) -> None:
    hub = Hub()
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    followed: dict[str, asyncio.Task[None]] = {}

    async def follow(topics: frozenset[str]) -> None:
        async for event in hub.messages(topics):
            if not event.startswith(_PREFIX):
                continue
            told = json.loads(event[len(_PREFIX) :])
            if told["topic"] == "maps":
                for name in told["value"] if isinstance(told["value"], list) else ():
                    if f"{LIVE}{name}" not in followed:
                        live = frozenset((f"{LIVE}{name}",))
                        followed[f"{LIVE}{name}"] = asyncio.ensure_future(follow(live))
            for message in export_messages(told["topic"], told["key"], told["value"], now_s=time.time()):
                channels.write(message)

    tasks = [
        asyncio.ensure_future(work)
        for work in (LocalFeed(hub, folder).run(), LiveFeed(hub, folder).run(), follow(_TOPICS))
    ]
    await stopped.wait()
    for task in (*tasks, *followed.values()):
        task.cancel()
    await asyncio.gather(*tasks, *followed.values(), return_exceptions=True)


def _pose(value: Mapping[str, Any], *, frame: str, now_s: float) -> dict[str, Any]:
    """Return ``foxglove.PoseInFrame`` of a pose of a live map; the frame is the map's."""
    T = np.asarray(value["T_map_camera"], dtype=np.float64).reshape(4, 4)
    x, y, z, w = (float(component) for component in to_quaternion(T[:3, :3]))
    stamp_s = value.get("timestamp_s")
    stamp_ns = round(1e9 * float(stamp_s if isinstance(stamp_s, int | float) else now_s))
    return {
        "timestamp": {"sec": stamp_ns // 1_000_000_000, "nsec": stamp_ns % 1_000_000_000},
        "frame_id": frame,
        "pose": {
            "position": dict(zip("xyz", (float(coordinate) for coordinate in T[:3, 3]), strict=True)),
            "orientation": {"x": x, "y": y, "z": z, "w": w},
        },
    }


def _topic_part(name: str) -> str:
    """Return a name of a robot or map as a part of a topic."""
    return _NOT_FOR_A_TOPIC.sub("_", name)[:64] or "_"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m rse_pf.fleet_page.foxglove_export")
    parser.add_argument("folder", type=Path, help="folder of the platform's state")
    parser.add_argument("--port", type=int, default=0, help="port on loopback; 0 takes a free one")
    parser.add_argument("--parent", type=int, default=None, help="process to end with")
    given = parser.parse_args()
    if given.parent is not None and not die_with_parent(given.parent):
        sys.exit(0)
    set_process_name("rse-pf foxglove")
    try:
        sys.exit(serve_foxglove(given.folder, port=given.port))
    except RsePfError as error:
        show_error(error)
        sys.exit(1)
