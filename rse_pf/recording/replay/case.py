"""Export one command as a case: a small recording that names nobody, and that anybody can replay.

A case holds the command, its answer, the commands of the same robot before it, and a thumbnail if the robot
allowed one; it holds no name, token, key, address or time of day.  Only commands of `pnp` can be exported:
their numbers are copied field by field, and nothing else of a message is.
"""

from __future__ import annotations

import base64
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from rse_pf.config import PnpSettings
from rse_pf.errors import BadRequest, RsePfError, UsageError, error_from_code
from rse_pf.geometry import Camera
from rse_pf.pnp import DepthNoise, PnpOptions
from rse_pf.pnp.engines import ENGINES
from rse_pf.recording import file_format
from rse_pf.recording.mcap_file import McapFile
from rse_pf.recording.reader import CASE_NAME, RecordedCommand
from rse_pf.recording.replay.picture import plain_thumbnail
from rse_pf.recording.replay.solving import Resolver, pnp_reply
from rse_pf.services.pnp import PnpReply, PnpRequest
from rse_pf.wire import Command, Failure, Result, make_codec

__all__ = ["CASE_SUFFIX", "MAX_CASE_BYTES", "case_parts", "write_case"]

CASE_SUFFIX = ".rsepf"
MAX_CASE_BYTES = 8 << 20
"""A stranger's file that is larger is not opened as a case."""

_CONNECTION, _ROBOT, _TENANT = "0" * 16, "robot-00000000", "tenant-00000000"
_KEPT_METADATA = ("version", "protocol", "engine", "side")
_WORD = re.compile("|".join((
    "ok", "weak", "none", "few-inliers", "low-inlier-ratio", "clustered", "nearly-collinear", "ambiguous",
    "poorly-constrained", *ENGINES,
)))  # fmt: skip
"""The words that a pose may hold."""
_VERSION = re.compile(r"[0-9A-Za-z.+]{1,32}")


class CasePart(msgspec.Struct, frozen=True, kw_only=True):
    """One message of a case: which channel, nanoseconds from the first one, and its data."""

    kind: str
    time_ns: int
    data: bytes


def case_parts(
    command: RecordedCommand, history: Sequence[RecordedCommand], resolver: Resolver
) -> list[CasePart]:
    """Return the messages of the case of *command*, in their order; earlier ones of its connection only.

    What a failure says is kept where *resolver* gives the same words for the command without names.

    Raises:
        BadRequest: It is no command of `pnp`, or its bytes cannot be read.
    """
    connection = command.id.partition(":")[0]
    commands = [*(past for past in history if past.id.startswith(f"{connection}:")), command]
    start_ns = min(recorded.sent_ns for recorded in commands)
    parts: list[CasePart] = []
    for earlier in commands:
        try:
            parts += _parts(earlier, start_ns, resolver)
        except RsePfError as error:
            if earlier is command:
                raise BadRequest(
                    f"this command cannot be exported: {error.message}", hint="only those of pnp can be"
                ) from error
    return parts


def write_case(
    path: Path,
    parts: Sequence[CasePart],
    *,
    codec: str,
    number: int,
    metadata: Mapping[str, str],
    version: str,
) -> int:
    """Write a case and return its size in bytes; a file of that name is replaced.

    Args:
        path: Of the new file.
        parts: Of `case_parts`.
        codec: Of the command.
        number: Its id.
        metadata: Of the recording.
        version: Of the platform that exports.

    Raises:
        UsageError: The file cannot be written.
    """
    versions = {name: metadata[name] for name in _KEPT_METADATA if _VERSION.fullmatch(metadata.get(name, ""))}
    versions |= {"format": str(file_format.FORMAT_VERSION), **_settings_of(metadata)}
    about = {"command": f"{_CONNECTION}:{number}", "exported_by": version}
    try:
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        try:
            file = McapFile(fd)
            file.begin(
                file_format.PROFILE, f"{file_format.LIBRARY} {version}",
                {file_format.METADATA_NAME: versions, CASE_NAME: about},
            )  # fmt: skip
            channels: dict[str, int] = {}
            for part in parts:
                if part.kind not in channels:
                    channels[part.kind] = _channel(file, part.kind, codec)
                file.add(channels[part.kind], part.time_ns, part.data)
            file.finish()
            return file.size_bytes
        finally:
            os.close(fd)
    except OSError as error:
        raise UsageError(f"{path} cannot be written: {error.strerror}", hint="choose another file") from error


def _settings_of(metadata: Mapping[str, str]) -> dict[str, str]:
    """Return the numbers by which the server solved, if they are known."""
    try:
        given = msgspec.json.decode(metadata.get("pnp", "{}"))
        settings = PnpSettings(
            engine=str(given["engine"]),
            max_iterations=int(given["max_iterations"]),
        )
    except (msgspec.DecodeError, RsePfError, KeyError, TypeError, ValueError):
        return {}
    return {"pnp": msgspec.json.encode(settings).decode()}


def _channel(file: McapFile, kind: str, codec: str) -> int:
    """Return the number of a new channel for one kind of message."""
    if kind in ("frames", "odometry"):
        prefix, schema = {
            "frames": (file_format.FRAMES_PREFIX, file_format.IMAGE_SCHEMA),
            "odometry": (file_format.ODOMETRY_PREFIX, file_format.ODOMETRY_SCHEMA),
        }[kind]
        described = schema, file_format.JSON_SCHEMA_ENCODING, file_format.SCHEMAS[schema]
        return file.channel(f"{prefix}{_ROBOT}", file_format.JSON_ENCODING, described)
    direction: file_format.Direction = "up" if kind == "up" else "down"
    wire = file_format.WireChannel(_CONNECTION, direction, codec, "", _ROBOT, _TENANT)
    return file.channel(
        file_format.wire_topic(_CONNECTION, direction), file_format.WIRE_ENCODING, None,
        file_format.wire_metadata(wire),
    )  # fmt: skip


def _parts(command: RecordedCommand, start_ns: int, resolver: Resolver) -> list[CasePart]:
    """Return one command and its answer, without names; times count from *start_ns*."""
    sent_ns = command.sent_ns - start_ns
    number = command.command.id
    mark = f"{_CONNECTION}:{number}"
    parts = []
    if command.odometry is not None:
        pose = command.odometry
        parts.append(
            CasePart(
                kind="odometry", time_ns=sent_ns,
                data=file_format.encode_json({
                    "command": mark, "number": pose.number, "timestamp_s": pose.timestamp_s - start_ns / 1e9,
                    "T_odom_camera": pose.T_odom_camera.ravel().tolist(),
                }),
            )
        )  # fmt: skip
    if command.thumbnail is not None:
        try:
            data = base64.b64encode(plain_thumbnail(command.thumbnail)).decode()
        except BadRequest:
            data = ""
        if data:
            image = {"command": mark, "timestamp": {"sec": 0, "nsec": 0}, "frame_id": _ROBOT}
            image |= {"format": "jpeg", "data": data}
            parts.append(CasePart(kind="frames", time_ns=sent_ns, data=file_format.encode_json(image)))
    encode = make_codec(command.codec).encode
    asked = encode(_nameless_command(command.command))
    parts.append(CasePart(kind="up", time_ns=sent_ns, data=asked))
    reply = command.reply
    if reply is not None and command.answered_ns is not None:
        answered = encode(_nameless_reply(reply, replace(command, command_bytes=asked), resolver))
        parts.append(CasePart(kind="down", time_ns=command.answered_ns - start_ns, data=answered))
    return parts


def _nameless_command(command: Command) -> Command:
    """Return *command* with the numbers of its payload, and without the words that its robot chose."""
    if command.service != "pnp" or not isinstance(command.payload, dict):
        raise BadRequest("it is no command of pnp", hint="choose another one")
    payload = _only(command.payload, PnpRequest)
    for name, kind in (("camera", Camera), ("options", PnpOptions), ("depth_noise", DepthNoise)):
        if isinstance(payload.get(name), dict):
            payload[name] = _scalars(_only(payload[name], kind), engine=name == "options")
        elif name in payload:
            payload[name] = None
    for name in ("points_world", "pixels", "depths_m"):
        if name in payload:
            payload[name] = _numbers(payload[name])
    return Command(
        id=command.id, service="pnp", payload=payload, seq=command.seq, keep=command.keep,
        deadline_ms=command.deadline_ms,
    )  # fmt: skip


def _nameless_reply(reply: Result | Failure, asked: RecordedCommand, resolver: Resolver) -> Result | Failure:
    """Return *reply* without the server, and without words that may be a robot's own."""
    if isinstance(reply, Failure):
        again = resolver.again(asked).answer
        code = error_from_code(reply.code, "").code  # one of the platform's
        if isinstance(again, Failure) and (again.message, again.hint) == (reply.message, reply.hint):
            return msgspec.structs.replace(again, code=code, server="", trace="")
        return Failure(id=reply.id, code=code, message="", retry_after_ms=reply.retry_after_ms)
    payload: Any = None
    pose = pnp_reply(reply)
    words = () if pose is None else (pose.verdict, pose.reason or "none", pose.engine)
    if pose is not None and all(map(_WORD.fullmatch, words)) and isinstance(reply.reply, dict):
        payload = _only(reply.reply, PnpReply)
        payload |= {name: _numbers(payload[name]) for name in ("T_camera_world", "inliers", "covariance")}
    return Result(
        id=reply.id, reply=payload, queue_ms=reply.queue_ms, compute_ms=reply.compute_ms,
        received_s=1.0, sent_s=1.0 + max(0.0, reply.sent_s - reply.received_s),
    )  # fmt: skip


def _only(given: Mapping[str, Any], kind: type[msgspec.Struct]) -> dict[str, Any]:
    """Return the fields of *given* that *kind* has, in their order."""
    known = set(kind.__struct_fields__)
    return {name: value for name, value in given.items() if name in known}


def _scalars(given: dict[str, Any], *, engine: bool) -> dict[str, Any]:
    """Return what is a number, and the name of an engine."""
    numbers = {name: number for name, number in given.items() if isinstance(number, int | float)}
    if engine and given.get("engine") in ENGINES:
        numbers["engine"] = given["engine"]
    return {name: numbers[name] for name in given if name in numbers}


def _numbers(value: Any) -> Any:
    """Return an array or a list of numbers as it is, None for anything else."""
    if isinstance(value, np.ndarray):
        return value
    if isinstance(value, list) and all(type(number) in (int, float) for number in value):
        return value
    return None
