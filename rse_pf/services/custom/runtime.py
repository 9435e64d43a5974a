"""Load an installed service and call it: one interface for Python, C/C++ and Lua.

Used inside of sandboxes only.  A payload reaches every language as it was sent: names, numbers, text, lists
and arrays.
"""

from __future__ import annotations

import collections.abc
import importlib
import importlib.util
import inspect
import sys
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import msgspec
import numpy as np

from rse_pf.errors import ConfigurationError, InternalError, RsePfError, message_of
from rse_pf.service import Registry, request_of
from rse_pf.services.custom.installed import InstalledService

__all__ = ["Runtime", "open_runtime"]


_BYTES = (bytes, bytearray, memoryview)
_ROWS = (list, tuple, np.ndarray)
_KINDS: dict[Any, tuple[type, ...]] = {
    float: (float, int, np.floating), int: (int, np.integer), str: (str,), bool: (bool,), bytes: _BYTES,
    list: _ROWS, tuple: _ROWS, np.ndarray: _ROWS, dict: (dict,), types.NoneType: (types.NoneType,),
    None: (types.NoneType,),
}  # fmt: skip
"""Annotation of a field of a reply, and what a robot can read as that."""


class Runtime(Protocol):
    """A loaded service."""

    has_snapshots: bool

    def call(self, payload: Any) -> Any:
        """Return the reply to *payload*: a struct, or plain values and arrays."""

    def snapshot(self) -> bytes:
        """Return the state, for `restore` in another process."""

    def restore(self, data: bytes) -> None:
        """Replace the state by one that `snapshot` returned."""


def open_runtime(service: InstalledService, scratch: Path) -> Runtime:
    """Load *service*, which may write files below *scratch* only.

    Raises:
        ConfigurationError: It cannot be loaded; the message says why.
        MissingExtra: Its language is not installed on this server.
    """
    if service.language in ("python", "package"):
        return _PythonRuntime(service)
    if service.language == "cpp":
        from rse_pf.services.custom.native import NativeRuntime

        return NativeRuntime(service, scratch)
    from rse_pf.services.custom.lua import LuaRuntime

    return LuaRuntime(service)


class _PythonRuntime:
    """A function ``serve(request: Request) -> Reply``, or a class ``Service`` with such a method."""

    def __init__(self, service: InstalledService) -> None:
        module = _load(service)
        maker = getattr(module, "Service", None)
        self._object: Any = maker() if callable(maker) else None
        function: Callable[[Any], Any] | None = getattr(self._object or module, "serve", None)
        if function is None:
            raise ConfigurationError(
                f"{service.entry} has neither a function serve nor a class Service",
                hint="write def serve(request: Request) -> Reply",
            )
        registry = Registry()
        registry.service(service.name)(function)
        self._service = registry.get(service.name)
        self._fields = _checked_fields(self._service.reply_type)
        self.has_snapshots = all(
            inspect.ismethod(getattr(self._object, name, None)) for name in ("snapshot", "restore")
        )

    def call(self, payload: Any) -> Any:
        service = self._service
        reply = service.function(request_of(payload, service))
        if not isinstance(reply, service.reply_type):
            raise InternalError(
                f"service {service.name!r} replied with a value of type {type(reply).__name__}, not with its "
                f"{service.reply_type.__name__}",
                hint="return from serve what it is annotated with",
            )
        for field, kinds, declared in self._fields:
            value = getattr(reply, field)
            if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
                raise InternalError(
                    f"service {service.name!r} replied with a {field} of type {type(value).__name__}, "
                    f"not with its {declared}",
                    hint=f"give {field} of {service.reply_type.__name__} what it is annotated with",
                )
        return reply

    def snapshot(self) -> bytes:
        state = self._object.snapshot()
        if not isinstance(state, (bytes, bytearray, memoryview)):
            raise InternalError(
                f"the snapshot of service {self._service.name!r} is of type {type(state).__name__}, "
                "not bytes",
                hint="encode it, for example with msgspec.msgpack.encode(state)",
            )
        return bytes(state)

    def restore(self, data: bytes) -> None:
        self._object.restore(data)


def _checked_fields(reply_type: type[Any]) -> list[tuple[str, tuple[type, ...], str]]:
    """Return each field whose type can be told at once: its name, its classes, and its annotation.

    What lists and maps hold is not looked at: that would cost as much as encoding them.
    """
    checked = []
    for field, annotation in typing.get_type_hints(reply_type).items():
        kinds = _kinds_of(annotation)
        if kinds:
            declared = annotation.__name__ if isinstance(annotation, type) else str(annotation)
            checked.append((field, kinds, declared))
    return checked


def _kinds_of(annotation: Any) -> tuple[type, ...]:
    """Return the classes of values that fit *annotation*, () if that cannot be told."""
    origin = typing.get_origin(annotation) or annotation
    if origin in (typing.Union, types.UnionType):
        arms = [_kinds_of(arm) for arm in typing.get_args(annotation)]
        return tuple(kind for arm in arms for kind in arm) if all(arms) else ()
    if isinstance(origin, type) and issubclass(origin, msgspec.Struct):
        return (origin,)
    return _KINDS.get(origin, ()) if isinstance(origin, collections.abc.Hashable) else ()


def _load(service: InstalledService) -> Any:
    try:
        if service.language == "package":
            return importlib.import_module(service.entry)
        return _load_file(service)
    except RsePfError:
        raise
    except Exception as error:
        where = f"{type(error).__name__}: {message_of(error)}"
        raise ConfigurationError(
            f"{service.name} cannot be loaded: {where}", hint="fix the service"
        ) from error


def _load_file(service: InstalledService) -> Any:
    name = f"rse_pf_service_{service.name.replace('-', '_')}"
    spec = importlib.util.spec_from_file_location(name, service.entry_path)
    if spec is None or spec.loader is None:
        raise ConfigurationError(
            f"{service.entry_path} is not a Python file", hint="correct entry in service.json"
        )
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    for folder in (service.folder, service.dependencies):  # the service's own packages come first
        if folder is not None and str(folder) not in sys.path:
            sys.path.insert(0, str(folder))
    spec.loader.exec_module(module)
    return module
