"""Functions for both shells: the topics to subscribe to, and the loop that runs a bridge until a signal."""

from __future__ import annotations

import asyncio
import contextlib
import signal

from ros_bridge.bridge import Bridge
from ros_bridge.incoming import Role, kind_of
from ros_bridge.options import BridgeOptions
from rse_pf.terminal import show

__all__ = ["end_by_signal", "queue_of", "run_until", "taken"]

# Topic on which RViz publishes the pose that an operator gives, as AMCL takes it.
_INITIAL_POSE: Role = "initialpose"
_ROLES: tuple[Role, ...] = ("info", "right_info", "imu", "odometry", "right", "depth", "colour")
_TF_ROLES: tuple[Role, ...] = ("tf_static", "tf")
# Length of the subscriber's queue of an IMU: half a second at 2 kHz.
_IMU_SAMPLES = 1000
# Length of the subscriber's queue of odometry and transforms: several nodes publish them, some at 200 Hz.
_TRANSFORMS = 100


def taken(options: BridgeOptions) -> list[tuple[Role, str, str]]:
    """Return role, name and type of each topic to subscribe to; transforms and camera_infos come first."""
    frames = [(role, f"/{role}", kind_of(role, "")) for role in _TF_ROLES]
    left_out = {"depth", "right"} - {options.partner}
    topics = ((role, str(getattr(options, role))) for role in _ROLES if role not in left_out)
    if options.map:
        frames.append((_INITIAL_POSE, options.named(_INITIAL_POSE), kind_of(_INITIAL_POSE, "")))
    return frames + [(role, options.named(topic), kind_of(role, topic)) for role, topic in topics if topic]


def queue_of(role: Role, options: BridgeOptions) -> int:
    """Return the length of the subscriber's queue for the topic *role*."""
    if role in ("odometry", _INITIAL_POSE, *_TF_ROLES):
        return _TRANSFORMS
    return _IMU_SAMPLES if role == "imu" else options.queue_frames


def end_by_signal() -> asyncio.Event:
    """Return an event that SIGINT and SIGTERM set; call this in the main thread, in a running event loop."""
    ended, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    return ended


async def run_until(bridge: Bridge, options: BridgeOptions, ended: asyncio.Event) -> None:
    """Run *bridge* until *ended* is set; print the topics first, and the number of frames at the end.

    An error of the bridge is raised.
    """
    show(f"bridging {options.named(options.colour)} to {options.named('rse_pf/pose')}")
    running, waiting = asyncio.create_task(bridge.run()), asyncio.create_task(ended.wait())
    await asyncio.wait([running, waiting], return_when=asyncio.FIRST_COMPLETED)
    for task in (waiting, running):
        task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await running
    show(f"{bridge.frames} frames, {bridge.lost_frames} lost")
