"""A fast decoder of ``pnp`` commands, which makes no Python object of each number.

The decoder accepts the messages that our SDKs send: known fields only, with arrays as lists of decimal
numbers of at most 15 digits (JSON) or as raw bytes (MessagePack). For any other message it returns None; the
codec then decodes the message, as that of any service, or reports the error.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from msgspec.msgpack import Ext

from rse_pf.errors import RsePfError
from rse_pf.geometry import Camera
from rse_pf.pnp import DepthNoise, PnpOptions
from rse_pf.pnp.native_solver import native_solver
from rse_pf.service import Registry
from rse_pf.services.pnp import PnpRequest
from rse_pf.wire import Command
from rse_pf.wire.arrays import Array, decode_hook, extension_hook

__all__ = ["pnp_reader"]

Value = TypeVar("Value")

_HEAD_BYTES = 128
"""Bytes at the start of a message in which the name ``pnp`` is searched: our SDKs write it before the
payload.  A message without the name there is left to the codec."""
_UNREADABLE = (msgspec.DecodeError, RecursionError, ValueError, TypeError, IndexError, RsePfError)
"""Errors of this decoder after which it returns None, so that the codec decodes the message or reports the
error."""


class _Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The fields of `Camera` without its checks, which `_validated` makes once for each camera."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


class _Options(PnpOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    pass


class _Noise(DepthNoise, frozen=True, kw_only=True, forbid_unknown_fields=True):
    pass


class _Request(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    camera: _Camera
    options: _Options | None = None
    depth_noise: _Noise | UnsetType | None = UNSET


class _TextRequest(_Request, kw_only=True, forbid_unknown_fields=True):
    """A JSON request in which `NativeSolver.cut_lists` replaced each list of numbers by a string.

    The string has one character, whose code is the index of the list among those that `cut_lists` returned.
    """

    points_world: str
    pixels: str
    depths_m: str | UnsetType | None = UNSET


class _BinaryRequest(_Request, kw_only=True, forbid_unknown_fields=True):
    points_world: Ext
    pixels: Ext
    depths_m: Ext | UnsetType | None = UNSET


class _TextCommand(Command, frozen=True, kw_only=True, tag="command", forbid_unknown_fields=True):
    service: Literal["pnp"]
    payload: _TextRequest


class _BinaryCommand(Command, frozen=True, kw_only=True, tag="command", forbid_unknown_fields=True):
    service: Literal["pnp"]
    payload: _BinaryRequest


def pnp_reader(registry: Registry, codec: str) -> Callable[[bytes | bytearray], Command | None] | None:
    """Return a function that decodes ``pnp`` commands of the encoding *codec*.

    The function returns a command with a `PnpRequest` as its payload, or None for a message that the codec
    must decode.

    Args:
        registry: Services of the server.
        codec: ``bin``, or a codec whose messages are JSON.

    Returns:
        The function.  None if *registry* has no service ``pnp``, or if its ``pnp`` is not the built-in one:
        the service of a user and a service that runs in another process receive the payload as the robot
        sent it, not as a `PnpRequest`.

    Raises:
        MissingExtra: The native core is not installed.
    """
    is_builtin = any(
        service.name == "pnp"
        and service.request_type is PnpRequest
        and service.kind == "stateless"
        and not service.limited
        for service in registry
    )
    if not is_builtin:
        return None
    decode_text = msgspec.json.Decoder(_TextCommand).decode
    decode_binary = msgspec.msgpack.Decoder(_BinaryCommand).decode
    cut_lists = native_solver().cut_lists

    def read_text(data: bytes | bytearray) -> Command | None:
        if b'"pnp"' not in data[:_HEAD_BYTES] or (cut := cut_lists(bytes(data))) is None:
            return None
        text, lists = cut
        try:
            command = decode_text(text)
            request = command.payload
            points_world, pixels = lists[ord(request.points_world)], lists[ord(request.pixels)]
            depths = request.depths_m
            depths_m = lists[ord(depths)] if isinstance(depths, str) else depths
            if len(lists) != 2 + isinstance(depths, str):
                return None  # A field other than points_world, pixels and depths_m holds a list of numbers.
            return _make_command(command, points_world, pixels, depths_m)
        except _UNREADABLE:
            return None

    def read_binary(data: bytes | bytearray) -> Command | None:
        if b"\xa3pnp" not in data[:_HEAD_BYTES]:
            return None
        try:
            command = decode_binary(data)
            request = command.payload
            depths_m = request.depths_m
            if depths_m:
                # Only the depths of a MessagePack command pass `decode_hook`, which raises an error if one is
                # not finite; the solver refuses such points and pixels later.
                depths_m = decode_hook(np.ndarray, _decode_array(depths_m))
            points_world, pixels = _decode_array(request.points_world), _decode_array(request.pixels)
            return _make_command(command, points_world, pixels, depths_m)
        except _UNREADABLE:
            return None

    return read_binary if codec == "bin" else read_text


def _make_command(
    command: _TextCommand | _BinaryCommand,
    points_world: Array,
    pixels: Array,
    depths_m: Array | UnsetType | None,
) -> Command:
    """Return *command* with a `PnpRequest` of the arrays as its payload."""
    fields = command.payload
    options, noise = fields.options, fields.depth_noise
    request = PnpRequest(
        camera=_validated(fields.camera, Camera),
        points_world=points_world,
        pixels=pixels,
        options=None if options is None else _validated(options, PnpOptions),
        depths_m=depths_m,
        depth_noise=_validated(noise, DepthNoise) if isinstance(noise, _Noise) else noise,
    )
    return Command(
        id=command.id,
        service=command.service,
        payload=request,
        stream=command.stream,
        seq=command.seq,
        keep=command.keep,
        deadline_ms=command.deadline_ms,
        trace=command.trace,
    )


def _decode_array(extension: Ext) -> Array:
    return extension_hook(extension.code, memoryview(extension.data))


@lru_cache(maxsize=256)
def _validated(fields: Any, kind: Callable[..., Value]) -> Value:
    """Return an instance of the class *kind* with the values of the struct *fields*, which *kind* checks.

    Results are cached, since all frames of a robot have the same camera.

    Raises:
        RsePfError: A value is out of its range.
    """
    return kind(**msgspec.structs.asdict(fields))
