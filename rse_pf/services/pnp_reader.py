"""Read `pnp` commands to requests at once, without a Python object for each number.

Only what the SDK sends is read here: known fields, and arrays of short decimal numbers or of raw bytes.  Any
other message is left to the codec, which reads the messages of all services and words the errors.
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
from rse_pf.native import native_solver
from rse_pf.pnp import DepthNoise, PnpOptions
from rse_pf.service import Registry
from rse_pf.services.pnp import PnpRequest
from rse_pf.wire import Command
from rse_pf.wire.arrays import Array, decode_hook, extension_hook

__all__ = ["pnp_reader"]

Part = TypeVar("Part")

# Only here is the name of the service sought: clients of ours write it before the payload.
_HEAD_BYTES = 128
_UNREADABLE = (msgspec.DecodeError, RecursionError, ValueError, TypeError, IndexError, RsePfError)


class _Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The fields of `Camera`, whose checks are made once for each camera (`_checked`)."""

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
    """Return what reads the `pnp` commands of the encoding *codec*, None if *registry* has no such service.

    It returns a command with a `PnpRequest` as its payload, None for what it does not read.  What another
    process computes, or another service of this name, gets its payload as the robot sent it.

    Raises:
        MissingExtra: The native core is not installed.
    """
    is_own = any(
        each.name == "pnp"
        and each.request_type is PnpRequest
        and each.kind == "stateless"
        and not each.limited
        for each in registry
    )
    if not is_own:
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
            parts = command.payload
            points_world, pixels = lists[ord(parts.points_world)], lists[ord(parts.pixels)]
            depths_m = parts.depths_m
            found = lists[ord(depths_m)] if isinstance(depths_m, str) else depths_m
            if len(lists) != 2 + isinstance(depths_m, str):
                return None  # one of them is in another field
            return _command(command, points_world, pixels, found)
        except _UNREADABLE:
            return None

    def read_binary(data: bytes | bytearray) -> Command | None:
        if b"\xa3pnp" not in data[:_HEAD_BYTES]:
            return None
        try:
            command = decode_binary(data)
            parts = command.payload
            depths_m = parts.depths_m
            if depths_m:
                depths_m = decode_hook(np.ndarray, _numbers(depths_m))  # the solver looks at the others
            return _command(command, _numbers(parts.points_world), _numbers(parts.pixels), depths_m)
        except _UNREADABLE:
            return None

    return read_binary if codec == "bin" else read_text


def _command(
    command: _TextCommand | _BinaryCommand,
    points_world: Array,
    pixels: Array,
    depths_m: Array | UnsetType | None,
) -> Command:
    """Return *command* with the arrays of its request."""
    parts = command.payload
    options, noise = parts.options, parts.depth_noise
    request = PnpRequest(
        camera=_checked(parts.camera, Camera),
        points_world=points_world,
        pixels=pixels,
        options=None if options is None else _checked(options, PnpOptions),
        depths_m=depths_m,
        depth_noise=_checked(noise, DepthNoise) if isinstance(noise, _Noise) else noise,
    )
    return Command(
        id=command.id, service="pnp", payload=request, stream=command.stream, seq=command.seq,
        keep=command.keep, deadline_ms=command.deadline_ms, trace=command.trace,
    )  # fmt: skip


def _numbers(extension: Ext) -> Array:
    """Return the raw numbers of *extension*."""
    return extension_hook(extension.code, memoryview(extension.data))


@lru_cache(maxsize=256)
def _checked(parts: Any, kind: Callable[..., Part]) -> Part:
    """Return *parts* as *kind*; a robot sends the same camera with every frame."""
    return kind(**msgspec.structs.asdict(parts))
