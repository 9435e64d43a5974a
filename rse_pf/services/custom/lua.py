"""The runtime of services in Lua: one LuaJIT virtual machine per robot (RSE-PF paper, Sect. 5.2 and Fig. 3).

A script returns a function of one table, or a table with ``serve`` and optionally ``snapshot`` and
``restore``.  A script may require ``json``, ``zlib`` and ``ffi``, and load shared libraries of its own
folder; it has no access to Python.  The process of the sandbox isolates the script, not the Lua machine.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from rse_pf.errors import (
    BadRequest,
    ConfigurationError,
    InternalError,
    MissingExtra,
    RsePfError,
    error_from_code,
)
from rse_pf.services.custom.installed import InstalledService
from rse_pf.wire.arrays import json_encode_hook

__all__ = ["LuaRuntime", "warm_up"]

# Most bytes that zlib.inflate returns to a script: 16 MiB, so that a bomb cannot fill the memory.  Longer
# output is cut off there without an error.
_MAX_INFLATED = 1 << 24
_MAX_LEVELS = 64
"""Most levels of nested tables in a reply or snapshot, so that a table that contains itself causes an error
instead of an endless recursion."""
_SETUP = """
local json_decode, json_encode, inflate, deflate, folder = ...
package.preload.json = function() return {decode = json_decode, encode = json_encode} end
package.preload.zlib = function() return {inflate = inflate, deflate = deflate} end
package.path = folder .. "/?.lua"
package.cpath = folder .. "/?.so;" .. folder .. "/build/?.so"
service_folder = folder
python = nil
return pcall
"""
"""Lua code that runs before a script: it makes the modules ``json`` and ``zlib``, restricts ``require`` to
the folder of the service, hides Python, and returns ``pcall``, by which the script is called."""


def warm_up() -> Any:
    """Load LuaJIT into this process and return the module ``lupa``; raises MissingExtra without it."""
    try:
        import lupa.luajit21 as lupa
    except ImportError as error:
        raise MissingExtra("lupa", "backend") from error
    return lupa


class LuaRuntime:
    """A virtual machine with a loaded script.

    Attributes:
        has_snapshots: Whether the script defines ``snapshot`` and ``restore``.
    """

    def __init__(self, service: InstalledService) -> None:
        """Run the script of *service*, which defines its functions.

        Raises:
            ConfigurationError: The script fails, or defines no function ``serve``.
            MissingExtra: LuaJIT is not installed.
        """
        lupa = warm_up()
        self._name = service.name
        self._lupa = lupa
        self._lua = lupa.LuaRuntime(
            unpack_returned_tuples=True,
            register_eval=False,
            register_builtins=False,
            attribute_filter=_no_attributes,
            encoding=None,
        )
        try:
            setup = self._lua.execute(f"return function(...) {_SETUP} end".encode())
            folder = str(service.folder).encode()
            self._pcall = setup(self._decode, self._encode, _inflate, zlib.compress, folder)
            returned = self._lua.execute(service.entry_path.read_bytes(), name=b"=" + service.entry.encode())
        except (lupa.LuaError, OSError, ValueError) as error:
            raise ConfigurationError(
                f"{service.name} cannot be loaded: {_first_line(error)}", hint="fix the script"
            ) from error
        self._functions: dict[str, Any] = {}
        if lupa.lua_type(returned) == "function":
            self._functions["serve"] = returned
        elif lupa.lua_type(returned) == "table":
            self._functions = {_text(key): value for key, value in returned.items()}
        if lupa.lua_type(self._functions.get("serve")) != "function":
            raise ConfigurationError(
                f"{service.entry} returns neither a function nor a table with serve",
                hint="end the script with: return function(request) ... end",
            )
        self._takes_text = bool(self._functions.get("takes_text"))
        self.has_snapshots = {"snapshot", "restore"} <= set(self._functions)

    def call(self, payload: Any) -> Any:
        """Return the reply of the script to *payload*.

        The function ``serve`` receives *payload* as a Lua table and returns a table.  If the table that the
        script returned has ``takes_text = true``, ``serve`` receives and returns JSON text instead.

        Raises:
            RsePfError: The script raised an error, see `_convert_error`.
            InternalError: The reply is not JSON, or holds a value that no message can hold.
        """
        if self._takes_text:
            return self._parse(self._run("serve", msgspec.json.encode(payload, enc_hook=json_encode_hook)))
        return self._from_lua(self._run("serve", self._to_lua(payload)))

    def snapshot(self) -> bytes:
        """Return what the script's ``snapshot`` returns as JSON; only with ``has_snapshots``.

        Raises:
            InternalError: JSON cannot hold the state.
            RsePfError: The script raised an error, see `_convert_error`.
        """
        return msgspec.json.encode(self._from_lua(self._run("snapshot"), "snapshot"))

    def restore(self, data: bytes) -> None:
        """Call the script's ``restore`` with the state that `snapshot` encoded; needs ``has_snapshots``."""
        self._run("restore", self._to_lua(msgspec.json.decode(data)))

    def _run(self, function: str, *arguments: Any) -> Any:
        try:
            result = self._pcall(self._functions[function], *arguments)
        except self._lupa.LuaError as error:
            # Out of memory, the only error that pcall does not catch.
            raise InternalError(f"{self._name}: {_first_line(error)}") from error
        is_success, value = (*result, None)[:2] if isinstance(result, tuple) else (result, None)
        if not is_success:
            raise self._convert_error(value)
        return value

    def _convert_error(self, error: Any) -> RsePfError:
        """Return the error that a script raised, as an error of the platform.

        ``error({code = "bad-request", message = "..."})`` becomes a failure with this code, or with the code
        ``failed`` if the table has none.  Any other error becomes an InternalError.
        """
        if isinstance(error, RsePfError):
            return error
        if self._lupa.lua_type(error) == "table":
            result = self._from_lua(error)
            if isinstance(result, Mapping) and "message" in result:
                return error_from_code(
                    str(result.get("code", "failed")), f"{self._name}: {result['message']}"
                )
        return InternalError(f"{self._name}: {_text(error)[:300]}")

    def _parse(self, text: Any) -> Any:
        hint = "return json.encode(reply), or leave takes_text out"
        if not isinstance(text, bytes):
            raise InternalError(
                f"service {self._name!r} replied with {self._kind(text)}, not with JSON text", hint=hint
            )
        try:
            return msgspec.json.decode(text)
        except msgspec.DecodeError as error:
            raise InternalError(
                f"service {self._name!r} replied with text that is not JSON: {error}", hint=hint
            ) from error

    def _to_lua(self, value: Any) -> Any:
        value = _encode_text(value)
        return self._lua.table_from(value, recursive=True) if isinstance(value, dict | list) else value

    def _from_lua(self, value: Any, what: str = "reply", level: int = 0) -> Any:
        """Return a Lua value as plain Python values: a table with the keys 1..n as a list, others as dicts.

        An empty table becomes an empty dict.  Keys of dicts become text.

        Args:
            value: The Lua value.
            what: What the value is, for the error: ``reply`` or ``snapshot``.
            level: Number of tables around the value.

        Raises:
            InternalError: The value, or one inside of it, is a function or something else that no message can
                hold, or tables are nested in more than `_MAX_LEVELS` levels.
        """
        if self._lupa.lua_type(value) != "table":
            if value is None or isinstance(value, bool | int | float):
                return value
            if isinstance(value, bytes):
                return _text(value)
            raise self._unencodable_error(what, self._kind(value))
        if level == _MAX_LEVELS:
            raise self._unencodable_error(
                what, f"tables in more than {_MAX_LEVELS} levels, or a table that holds itself"
            )
        length = len(value)
        if length and sum(1 for _ in value.keys()) == length:  # noqa: SIM118  a Lua table is not a mapping
            return [self._from_lua(value[i], what, level + 1) for i in range(1, length + 1)]
        return {_text(key): self._from_lua(item, what, level + 1) for key, item in value.items()}

    def _kind(self, value: Any) -> str:
        return f"a {self._lupa.lua_type(value) or type(value).__name__}"

    def _unencodable_error(self, what: str, held: str) -> InternalError:
        return InternalError(
            f"the {what} of service {self._name!r} holds {held}, which no message can hold",
            hint="return nil, booleans, numbers, strings, and tables of these",
        )

    def _decode(self, text: bytes) -> Any:
        try:
            return self._to_lua(msgspec.json.decode(text))
        except msgspec.DecodeError as error:
            raise BadRequest(f"not JSON: {error}") from error

    def _encode(self, value: Any) -> bytes:
        return msgspec.json.encode(self._from_lua(value))


def _encode_text(value: Any) -> Any:
    """Return *value* with all text as bytes, which are the strings of Lua, and arrays as lists."""
    if isinstance(value, str):
        return value.encode()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key).encode(): _encode_text(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_encode_text(item) for item in value]
    return value


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _inflate(data: bytes) -> bytes:
    return zlib.decompressobj().decompress(data, _MAX_INFLATED)


def _no_attributes(thing: object, name: object, setting: bool) -> object:
    raise AttributeError(f"the attribute {name!r} of a Python object is not available to scripts")


def _first_line(error: BaseException) -> str:
    return str(error).split("\n")[0][:300]
