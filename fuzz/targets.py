"""The fuzz targets: one function for each part of the product that reads bytes from outside.

A target accepts any bytes.  If the product violates one of its rules, the target raises `TargetFailure` or
the error of the product.  Targets are deterministic and use no socket and no file.
"""

from __future__ import annotations

import zlib
from typing import Any

import msgspec
import numpy as np

from fuzz import core_targets, live_targets, map_targets, stereo_targets
from fuzz.checks import Target, TargetFailure, expect
from fuzz.meter import Meter
from rse_pf.config import PlatformSettings, SessionSettings
from rse_pf.errors import InternalError, ProtocolError, RsePfError
from rse_pf.server.gateway.frames import (
    MAX_CONTROL_PER_S,
    CloseBorder,
    CloseSocket,
    FrameAssembler,
    FrameDecision,
    Received,
    SendPong,
)
from rse_pf.service import Service, dispatch, request_of
from rse_pf.services.builtin import builtin_services
from rse_pf.services.pnp import PnpRequest
from rse_pf.services.pnp_reader import pnp_reader
from rse_pf.wire import CODECS, Codec, Command, Failure, Result, as_type, make_codec
from rse_pf.wire.arrays import decode_hook, json_encode_hook
from rse_pf.wire.envelope import peek, undecodable_id
from rse_pf.wire.server_codec import make_server_codec

__all__ = ["TARGETS", "Target", "TargetFailure", "codec", "framed", "frames", "geometry", "stream"]

PLATFORM = PlatformSettings()  # settings with the default limits of a server
# Low limits of messages and fragments, which short inputs of the target ``frames`` can exceed.
NARROW = SessionSettings(max_message_bytes=2000, max_fragments=4)
NARROW_CONTROL_PER_S = 3.0  # limit of control frames per second of the target ``frames``
# Opcodes of WebSocket frames (RFC 6455, section 5.2).
_CONTINUATION = 0
_TEXT = 1
_BINARY = 2
_CLOSE = 8
_PING = 9
_PONG = 10

# Codecs that the first byte of an input selects; the fourth choice also deflates the message.
_CODECS = ("bin", "json", "zlib", "zlib")
# Each codec has its own encoder: MessagePack has maps with keys of None, JSON integers of more than 64 bits.
_ENCODERS = {
    "bin": msgspec.msgpack.Encoder(enc_hook=json_encode_hook).encode,
    "json": msgspec.json.Encoder(enc_hook=json_encode_hook).encode,
}
_SHORT = 8192
"""Longest message, in bytes, whose payload is passed to every service; it bounds the time of an input."""
# The built-in services.
_REGISTRY = builtin_services(PLATFORM)
# Codecs of a server, by name.
_MADE = {
    name: make_server_codec(name, PLATFORM.session, read_first=pnp_reader(_REGISTRY, name)) for name in CODECS
}
# Codecs of a robot, by name.
_OF_ROBOTS = {name: make_codec(name, PLATFORM.session) for name in CODECS}
# The built-in services, by which payloads are tried.
_SERVICES: tuple[Service, ...] = tuple(_REGISTRY)


def codec(data: bytes, meter: Meter) -> None:
    """Check the codec that the first byte selects with the other bytes as its message.

    Only protocol errors may be raised; a decoded message is equal after encoding and decoding; a payload
    gives a request of a service or one of our errors.  The codecs of server and robot decode the same
    message.
    """
    if not data:
        return
    kind, body = data[0] % 4, data[1:]
    chosen = _MADE[_CODECS[kind]]
    if kind == 3:
        body = zlib.compress(body, 1)
    meter.call(lambda sent: peek(chosen, sent), body, ProtocolError)
    meter.call(lambda sent: undecodable_id(chosen, sent), body, ProtocolError)
    # A robot trusts its server: the cost of decoding the server's messages is not limited.
    for decode, counted in ((chosen.decode_from_robot, meter), (chosen.decode_from_server, Meter())):
        message = counted.call(decode, body, ProtocolError)
        if message is None:
            continue
        again = chosen.encode(message)
        # An encoded message may be longer than the limit for received ones.
        if len(again) <= PLATFORM.session.max_message_bytes and chosen.encode(decode(again)) != again:
            raise TargetFailure(f"a {type(message).__name__} changed when it was encoded and decoded again")
        if isinstance(message, Command) and len(body) < _SHORT:
            _as_requests(message.payload)
    _compare_with_robots(chosen, body)


def _compare_with_robots(chosen: Codec, data: bytes) -> None:
    """Check that the server's codec *chosen* decodes and refuses the same messages as the robot's codec."""
    got, expected = (_outcome(each, data) for each in (chosen, _OF_ROBOTS[chosen.name]))
    if chosen.name == "zlib" and (got[0] == "zlib" or expected[0] == "zlib"):
        return  # isal ignores the size of the window in the zlib header, which decoding does not need
    expect(got == expected, "server and robot decode a message differently")


def _outcome(chosen: Codec, data: bytes) -> tuple[str, bytes]:
    """Decode *data*; return the code of the error, or ``read`` and the message with its request, encoded."""
    try:
        message = chosen.decode_from_robot(data)
        if isinstance(message, Command) and message.service == "pnp":
            request = as_type({} if message.payload is None else message.payload, PnpRequest)
            for array in (request.points_world, request.pixels):
                decode_hook(np.ndarray, array)  # a server leaves numbers that are not finite to the solver
            message = msgspec.structs.replace(message, payload=request)
    except RsePfError as error:
        return "zlib" if "zlib" in error.message else error.code, b""
    return "read", _ENCODERS["bin" if chosen.name == "bin" else "json"](message)


def _as_requests(payload: Any) -> None:
    for service in _SERVICES:
        try:
            request_of(payload, service)
        except InternalError as error:
            raise TargetFailure(f"{service.name} reports a payload as an internal error") from error
        except RsePfError:
            continue


def framed(data: bytes) -> list[tuple[int, bool, bool, bytes, float]]:
    """Read any bytes as frames: opcode, fin, rsv, payload and the time of each."""
    found, i, now = [], 1, 0.0
    while i + 3 <= len(data) and len(found) < 300:
        head, size, pause = data[i], data[i + 1], data[i + 2]
        size *= 16 if head & 32 else 1
        i += 3
        payload = data[i : i + size]
        i += len(payload)
        payload += b"." * (size - len(payload))
        now += pause / 64.0
        opcode = head & 15
        found.append((opcode, bool(head & 128), bool(head & 64) and head & 16 != 0, payload, now))
    return found


def frames(data: bytes, meter: Meter) -> None:
    """Check that any frames give messages of allowed size, pongs at an allowed rate, or one close code."""
    limits, control_per_s = (
        (NARROW, NARROW_CONTROL_PER_S) if data[:1] < b"\x80" else (PLATFORM.session, MAX_CONTROL_PER_S)
    )
    sent = framed(data)

    def receive_all(_: bytes) -> list[FrameDecision | None]:
        assembler = FrameAssembler(limits, max_control_per_s=control_per_s)
        return [assembler.receive(*frame) for frame in sent]

    decisions = meter.call(receive_all, data, ProtocolError)
    parts, opened, pongs, over = list[bytes](), 0, list[float](), False
    for (opcode, fin, rsv, payload, now), decision in zip(sent, decisions, strict=True):
        if over:
            expect(decision is None, f"{decision!r} after the close")
            continue
        if opcode in (_TEXT, _BINARY):
            parts, opened = [payload], opcode
        elif opcode == _CONTINUATION:
            parts.append(payload)
        over = isinstance(decision, CloseSocket)
        if rsv or opcode not in (_CONTINUATION, _TEXT, _BINARY, _CLOSE, _PING, _PONG):
            expect(over, "a frame that RFC 6455 forbids did not end the socket")
        if isinstance(decision, CloseSocket):
            expect(1000 <= decision.code <= 4999, "a close code that nobody may send")
        elif isinstance(decision, Received):
            _check_message(decision, parts, opened, limits, fin)
            parts = []
        elif isinstance(decision, SendPong):
            pongs.append(now)
            expect(opcode == _PING and decision.data == payload and len(payload) <= 125, "a wrong pong")
            recent = [at for at in pongs if at > now - 1.0]
            expect(len(recent) <= 2 * max(1.0, control_per_s), "pongs beyond the rate")
        else:
            expect(decision is None, f"{decision!r} is no decision")
            expect(len(parts) <= limits.max_fragments, "more fragments than allowed are held")
            expect(sum(map(len, parts)) <= limits.max_message_bytes, "more bytes than allowed are held")


def _check_message(
    message: Received, parts: list[bytes], opened: int, limits: SessionSettings, fin: bool
) -> None:
    expect(fin, "a message ended without its last frame")
    expect(message.data == b"".join(parts), "a message is not what its frames held")
    expect(message.is_text == (opened == _TEXT), "a message changed its kind")
    expect(len(message.data) <= limits.max_message_bytes, "a message above the limit")
    expect(len(parts) <= limits.max_fragments, "a message of more fragments than allowed")
    if message.is_text:
        message.data.decode()


def stream(data: bytes, meter: Meter) -> None:
    """Check that the close frame is found at the same byte for any fragmentation of the stream."""
    if len(data) < 2:
        return
    step, body = data[0] % 23 + 1, data[1:]

    def taken(pieces: list[memoryview]) -> int:
        border = CloseBorder(upgraded=True)
        return sum(border.bytes_to_close(piece, len(piece)) for piece in pieces)

    whole = meter.call(lambda sent: taken([memoryview(sent)]), body, ProtocolError)
    cut = [memoryview(body)[i : i + step] for i in range(0, len(body), step)]
    expect(taken(cut) == whole, f"cut each {step} bytes, the stream ends elsewhere")


def geometry(data: bytes, meter: Meter) -> None:
    """Check that any numbers give a rigid pose or a typed failure, and that points on a line are not ok."""
    if len(data) < 8:
        return
    engine = ("opencv", None)[data[0] % 2]
    n = data[1] % 40
    numbers = _numbers(data[2] % 3, data[8:], 5 * n)
    points, pixels = numbers[: 3 * n], numbers[3 * n :]
    options = {"inlier_px": data[3] / 8.0, "max_iterations": data[4] * 8, "confidence": data[5] / 255.0}
    camera = {
        "fx": 500.0 + data[6], "fy": 500.0 + data[7], "cx": 320.0, "cy": 240.0, "width": 640, "height": 480,
    }  # fmt: skip
    payload: dict[str, Any] = {"camera": camera, "points_world": points, "pixels": pixels}
    if data[3]:
        payload["options"] = options | ({"engine": engine} if engine else {})
    if data[6] % 2:
        payload["depths_m"] = [abs(number) for number in numbers[:n]]
        payload["depth_noise"] = {"base_m": (1.0 + data[7]) / 256.0}
    command = Command(id=1, service="pnp", payload=payload)
    answer = meter.call(lambda _: dispatch(_REGISTRY, command, lambda: 0.0), data, ProtocolError)
    if isinstance(answer, Failure):
        expect(answer.code != "internal", f"a defect: {answer.message}")
        return
    check_pose(answer, np.reshape(points, (-1, 3)))


def check_pose(answer: Result, points: np.ndarray) -> None:
    """Raise `TargetFailure` if the pose is not rigid, or is ``ok`` for points on a line or a single point."""
    reply = answer.reply
    T = np.asarray(reply.T_camera_world).reshape(4, 4)
    expect(bool(np.isfinite(T).all() and np.isfinite(reply.covariance).all()), "a pose that is not finite")
    expect(bool(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-6), "not a rotation")
    expect(bool(np.linalg.det(T[:3, :3]) > 0.0), "a reflection")
    inliers = points[np.asarray(reply.inliers, dtype=int)]
    expect(len(inliers) >= 4, "a pose of fewer than four matches")
    spread = np.linalg.svd(inliers - inliers.mean(axis=0), compute_uv=False)
    on_a_line = spread[1] <= 1e-6 * max(spread[0], 1e-300)
    expect(not (on_a_line and reply.verdict == "ok"), "points on one line were called ok")


def _numbers(kind: int, data: bytes, count: int) -> list[float]:
    if kind == 0:
        whole = np.frombuffer(data[: len(data) // 8 * 8], "<f8")
        found = whole[np.isfinite(whole)]
    elif kind == 1:
        found = np.frombuffer(data, np.int8).astype(np.float64)
    else:
        found = np.frombuffer(data[: len(data) // 2 * 2], "<i2").astype(np.float64) / 32.0
    return np.resize(found, count).tolist() if len(found) else [0.0] * count


# The fuzz targets by name.
TARGETS: dict[str, Target] = {
    "codec": codec, "frames": frames, "stream": stream, "geometry": geometry, "maps": map_targets.maps,
    "keyframes": map_targets.keyframes, "snapshots": map_targets.snapshots, "graph": map_targets.graph,
    "cloud": map_targets.cloud, "match": core_targets.match,
    "depth": core_targets.depth, "describe": core_targets.describe,
    "track": core_targets.track, "stereo": stereo_targets.stereo,
    "live": live_targets.live,
}  # fmt: skip
