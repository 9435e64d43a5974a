"""Fuzz maps, keyframes, messages of sandboxes, pose graphs and point clouds.

Maps and payloads of map services are computed in processes that may be killed; messages of a sandbox are
read in the worker itself, so that their cost has the limits of a message of a robot.
"""

from __future__ import annotations

import struct
import time
import zlib
from typing import Any

import numpy as np

from fuzz.checks import TargetFailure, expect
from fuzz.meter import Meter
from rse_pf.config import PlatformSettings
from rse_pf.errors import BadRequest, RsePfError
from rse_pf.geometry import Camera
from rse_pf.maps.format import Keyframe, MapVersion, decode_map, encode_map
from rse_pf.processes.ipc import FrameReader
from rse_pf.server.sandbox.channel import outcome_of
from rse_pf.server.sandbox.policy import SandboxReply
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.wire import Command, Failure, Result, make_codec
from tests.kit.synthetic_maps import make_world

__all__ = ["cloud", "graph", "keyframes", "maps", "snapshots"]

# Settings of a server with its default limits.
_SETTINGS = PlatformSettings()
# The built-in services.
_REGISTRY = builtin_services(_SETTINGS)
# Codecs that encode results and answers.
_CODECS = tuple(make_codec(name, _SETTINGS.session) for name in ("bin", "json"))
_MAGIC = b"RSEMAP1\n"  # first bytes of a map
_LONG_TEXT = 16_384
"""Longest text of a pose graph in bytes, so that many graphs are tried in a second; the rest is ignored."""
# Camera of the keyframes, px.
_CAMERA = Camera(fx=525.0, fy=525.0, cx=319.5, cy=239.5, width=640, height=480)


def maps(data: bytes, meter: Meter) -> None:
    """Check that any bytes give a map or a typed error.

    If the first byte is even, the other bytes are deflated here before they are decoded.  A map is equal
    after encoding and decoding; its provenance is readable or raises BadRequest.
    """
    if not data:
        return
    body = _MAGIC + zlib.compress(data[1:], 1) if data[0] % 2 == 0 else data[1:]
    version = meter.call(decode_map, body, RsePfError)
    if version is None:
        return
    try:
        dict(version.provenance)
    except BadRequest:
        return
    again = encode_map(version)
    if encode_map(decode_map(again)) != again:
        raise TargetFailure("a map changed when it was encoded and decoded again")


def keyframes(data: bytes, meter: Meter) -> None:
    """Check that ``place`` and ``localise`` answer any features of a keyframe, or fail with a typed error.

    The first bytes choose the number of features, the position of each array in *data*, and the options.
    """
    if len(data) < 8:
        return
    count, places = data[0] % 64, data[1:4]
    body = data[8:] or b"\0"

    def array(place: int, size: int) -> bytes:
        begin = place * len(body) // 256
        turned = body[begin:] + body[:begin]
        return (turned * (size // len(turned) + 1))[:size]

    pixels = np.frombuffer(array(places[0], 8 * count), "<f4").reshape(-1, 2)
    points = np.frombuffer(array(places[1], 12 * count), "<f4").reshape(-1, 3)
    descriptors = np.frombuffer(array(places[2], 32 * count), np.uint8).reshape(-1, 32)
    try:
        keyframe = Keyframe(
            id=_WORLD.keyframes[0].id, robot="r", timestamp_s=1.0, T_world_camera=np.eye(4), camera=_CAMERA,
            pixels=pixels, descriptors=descriptors, points_camera=points,
        )  # fmt: skip
    except BadRequest:
        keyframe = _WORLD.keyframes[0]
    version = MapVersion(keyframes=(keyframe, *_WORLD.keyframes[1:]))
    view = _WORLD.keyframes[0] if data[4] % 2 else keyframe
    payload = {
        "map": encode_map(version), "camera": _CAMERA, "pixels": view.pixels.ravel().tolist(),
        "descriptors": view.descriptors.tobytes(),
    }  # fmt: skip
    for service in ("place", "localise"):
        _asked(service, payload, data, meter)


def snapshots(data: bytes, meter: Meter) -> None:
    """Check that any output of a sandbox gives messages or a typed error, and that answers can be encoded.

    The first byte decides whether the others are a stream, or one message whose length is written here.
    """
    if not data:
        return
    stream = data[1:] if data[0] % 2 else struct.pack("<I", len(data) - 1) + data[1:]
    messages = meter.call(_read_all, stream, RsePfError) or []
    for message in messages:
        try:
            outcome = outcome_of(message)
        except RsePfError:
            continue
        if not isinstance(outcome, SandboxReply):
            continue
        expect(isinstance(outcome.snapshot, bytes | None), "a snapshot that is not bytes")
        expect(0.0 <= outcome.compute_ms < 1e9, "a time that is not finite")
        for codec in _CODECS:
            try:
                codec.encode(Result(id=1, reply=outcome.value, compute_ms=outcome.compute_ms))
            except RsePfError:
                continue


def _read_all(stream: bytes) -> list[Any]:
    return list(FrameReader(_SETTINGS.session.max_inflated_bytes).feed(stream))


def graph(data: bytes, meter: Meter) -> None:
    """Check that any text as a pose graph gives poses or a typed failure."""
    text = data[:_LONG_TEXT].decode("utf-8", "replace")
    _asked("optimise", {"g2o": text}, data, meter)


def cloud(data: bytes, meter: Meter) -> None:
    """Check that any numbers as two point clouds give a pose or a typed failure.

    The first bytes choose the form of the numbers, their count and the options.
    """
    if len(data) < 12:
        return
    kind, count = data[0] % 4, 3 * (100 + data[1])
    numbers = _numbers(kind, data[12:], 2 * count)
    if data[2] % 2:  # a valid target cloud, so that the solver is reached
        numbers[:count] = (np.array(_ROOM[:count]) * (1.0 + data[3])).tolist()
    options = {
        "voxel_m": (data[4] + 1) / 64.0, "reach_m": (data[5] + 1) / 8.0, "max_iterations": data[6],
        "min_overlap": data[7] / 255.0, "max_motion_m": data[8] / 8.0, "max_motion_deg": float(data[9]),
    }  # fmt: skip
    guess = np.eye(4)
    guess[:3, 3] = np.array(_numbers(kind, data[-24:], 3)) if data[10] % 2 else 0.0
    payload: dict[str, Any] = {
        "target": numbers[:count], "source": numbers[count:], "T_target_source": guess.ravel().tolist(),
    }  # fmt: skip
    if data[11] % 2:
        payload["options"] = options
    _asked("icp", payload, data, meter)


def _asked(service: str, payload: dict[str, Any], data: bytes, meter: Meter) -> None:
    command = Command(id=1, service=service, payload=payload)
    answer = meter.call(lambda _: dispatch(_REGISTRY, command, time.monotonic), data, RsePfError)
    if isinstance(answer, Failure):
        expect(answer.code not in ("internal", "missing-extra"), f"{service}: {answer.code} {answer.message}")
        return
    for codec in _CODECS:
        codec.encode(answer)
    if service == "icp":
        numbers = np.asarray(answer.reply.T_target_source)
        expect(bool(np.isfinite(numbers).all()), "a pose that is not finite")
        expect(np.isfinite(answer.reply.misfit_after_m), "a misfit that is not finite")
    if service == "optimise":
        expect(np.isfinite(answer.reply.cost_after), "a cost that is not finite")
        expect(answer.reply.cost_after <= answer.reply.cost_before, "a graph that fits worse than before")


def _numbers(kind: int, data: bytes, count: int) -> list[float]:
    if kind == 0:
        found = np.frombuffer(data[: len(data) // 8 * 8], "<f8")
    elif kind == 1:
        found = np.frombuffer(data, np.int8).astype(np.float64)
    elif kind == 2:
        found = np.frombuffer(data[: len(data) // 2 * 2], "<i2").astype(np.float64) / 256.0
    else:
        with np.errstate(invalid="ignore"):  # a signalling NaN becomes a quiet NaN
            found = np.frombuffer(data[: len(data) // 4 * 4], "<f4").astype(np.float64)
    return np.resize(found, count).tolist() if len(found) else [0.0] * count


_WORLD, _ = make_world(7, points=400).walk("robot-1", np.linspace(0.0, 0.1, 3), seed=2)
# Points on the walls of a room, metres: the valid target cloud.
_ROOM = np.random.default_rng(1).uniform(0, 4, 3000).reshape(-1, 3)
_ROOM[np.arange(1000), np.arange(1000) % 3] = 0.0
_ROOM = _ROOM.ravel().tolist()
