"""Load an installed service into a sandbox: the interface of all runtimes, and the runtime of Python.

Only the processes of sandboxes use this module.  The runtime of every language receives the payload of a
command as the robot sent it: a map from names of fields to numbers, texts, lists, maps and arrays.  The
runtime of Python converts the payload to the request type of the service.
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
    float: (float, int, np.floating),
    int: (int, np.integer),
    str: (str,),
    bool: (bool,),
    bytes: _BYTES,
    list: _ROWS,
    tuple: _ROWS,
    np.ndarray: _ROWS,
    dict: (dict,),
    types.NoneType: (types.NoneType,),
    None: (types.NoneType,),
}
"""For each annotation of a field of a reply, the classes of values that a message encodes as this annotation
states: for ``float`` also integers and numpy's floats, for ``list`` also tuples and arrays."""


class Runtime(Protocol):
    """A loaded service of any language.

    Attributes:
        has_snapshots: Whether the service has `snapshot` and `restore`, so that its state survives its
            process.
    """

    has_snapshots: bool

    def call(self, payload: Any) -> Any:
        """Return the reply to *payload*: a struct, or plain values and arrays.

        Raises:
            RsePfError: The service refuses the request, fails, or replies with what no message can hold.
                Code in Python may raise any other exception as well.
        """

    def snapshot(self) -> bytes:
        """Return the state of the service, for `restore` in another process; only with ``has_snapshots``."""

    def restore(self, data: bytes) -> None:
        """Replace the state of the service by the snapshot *data*; only with ``has_snapshots``."""


def open_runtime(service: InstalledService, scratch: Path) -> Runtime:
    """Load *service* by the runtime of its language.

    Args:
        service: The service, usually the verified copy.
        scratch: Folder in which the service may write files.

    Raises:
        ConfigurationError: The service cannot be loaded; the message says why.
        MissingExtra: The language of the service is not installed on this server.
    """
    if service.language in ("python", "package"):
        return _PythonRuntime(service)
    if service.language == "cpp":
        from rse_pf.services.custom.cpp import CppRuntime

        return CppRuntime(service, scratch)
    from rse_pf.services.custom.lua import LuaRuntime

    return LuaRuntime(service)


class _PythonRuntime:
    """The runtime of Python: calls the method ``serve`` of a class ``Service``, else a function ``serve``.

    One object of the class is made when the service is loaded, and keeps the state between calls.
    """

    def __init__(self, service: InstalledService) -> None:
        module = _load_module(service)
        service_class = getattr(module, "Service", None)
        self._object: Any = service_class() if callable(service_class) else None
        function: Callable[[Any], Any] | None = getattr(self._object or module, "serve", None)
        if function is None:
            raise ConfigurationError(
                f"{service.entry} has neither a function serve nor a class Service",
                hint="write def serve(request: Request) -> Reply",
            )
        registry = Registry()
        registry.service(service.name)(function)
        self._service = registry.get(service.name)
        self._fields = _list_checkable_fields(self._service.reply_type)
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


def _list_checkable_fields(reply_type: type[Any]) -> list[tuple[str, tuple[type, ...], str]]:
    """Return name, allowed classes and annotation of each field of a reply that ``isinstance`` can check.

    The elements of lists and maps are not checked: that would take as long as to encode them.
    """
    fields = []
    for field, annotation in typing.get_type_hints(reply_type).items():
        kinds = _allowed_classes(annotation)
        if kinds:
            declared = annotation.__name__ if isinstance(annotation, type) else str(annotation)
            fields.append((field, kinds, declared))
    return fields


def _allowed_classes(annotation: Any) -> tuple[type, ...]:
    """Return the classes of the values that *annotation* allows; empty if ``isinstance`` cannot decide."""
    origin = typing.get_origin(annotation) or annotation
    if origin in (typing.Union, types.UnionType):
        members = [_allowed_classes(member) for member in typing.get_args(annotation)]
        return tuple(kind for member in members for kind in member) if all(members) else ()
    if isinstance(origin, type) and issubclass(origin, msgspec.Struct):
        return (origin,)
    return _KINDS.get(origin, ()) if isinstance(origin, collections.abc.Hashable) else ()


def _load_module(service: InstalledService) -> Any:
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
    # Each folder is put in front of sys.path, so that the packages of the service are found before the files
    # of its own folder.
    for folder in (service.folder, service.dependencies):
        if folder is not None and str(folder) not in sys.path:
            sys.path.insert(0, str(folder))
    spec.loader.exec_module(module)
    return module
