"""Small files that hold state: replaced in one step, and private where they hold a secret.

A reader of a replaced file sees the old content or the new one, never a part of either.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import secrets
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rse_pf.errors import UsageError

__all__ = [
    "OWNER_ONLY", "TEMPORARY_PREFIX", "check_exists", "create_private_file", "read_document",
    "read_private_file", "read_regular_file", "replace_file", "replace_json", "sync_folder",
]  # fmt: skip

OWNER_ONLY = 0o600
"""Mode of a file that holds a secret."""
TEMPORARY_PREFIX = ".part-"
"""Prefix of temporary files; a writer that is killed leaves one behind."""
_BY_UMASK = 0o666  # mode of other files, from which the umask is taken
_OTHERS = 0o077  # bits of a mode that give permissions to group or others
_MAX_BYTES = 1 << 20  # of a file with a secret: a longer one is a mistake of its path
_MAX_DOCUMENT_BYTES = 16 << 20  # of a JSON document that is read as a whole


def check_exists(path: Path | str, hint: str) -> None:
    """Refuse a path that does not exist, and name the first folder of it that is missing.

    Raises:
        UsageError: Neither a file nor a folder is there.
    """
    path = Path(path)
    missing = [each for each in (path, *path.parents) if not each.exists()]
    if missing:
        where = f": there is no folder {missing[-1]}" if len(missing) > 1 else ""
        raise UsageError(f"{path} does not exist{where}", hint=hint)


def replace_file(
    path: Path | str, data: bytes | str, *, mode: int = _BY_UMASK, is_durable: bool = False
) -> None:
    """Replace *path* by a file of *data* in one step, or raise OSError and leave it as it is.

    Args:
        path: The file; its folder exists.
        data: The whole content; text is written as UTF-8.
        mode: Permissions of the new file; the umask is taken off.
        is_durable: Whether content and name survive a power failure once this returns.
    """
    folder = os.path.dirname(path) or "."
    temporary = f"{folder}/{TEMPORARY_PREFIX}{secrets.token_hex(8)}"
    handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    try:
        _write(handle, data, is_durable)
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(temporary)
        raise
    if is_durable:
        sync_folder(folder)


def replace_json(path: Path, value: Any, *, indent: int | None = None) -> None:
    """Replace *path* by the JSON document of *value* in one step; raises OSError."""
    replace_file(path, json.dumps(value, indent=indent))


def create_private_file(path: Path, text: str) -> None:
    """Write *text* durably to a new file that only its owner can read; raises OSError, also if it exists."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, OWNER_ONLY)
    _write(handle, text, True)


def read_regular_file(path: Path, max_bytes: int) -> bytes:
    """Return the content of a file that may come from a stranger.

    Raises:
        OSError: It cannot be read, is a pipe or a device, or is longer than *max_bytes*.
    """
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "it is not a regular file", str(path))
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise OSError(errno.EFBIG, f"it is longer than {max_bytes} bytes", str(path))
    return data


def read_document(
    path: Path,
    content: str,
    *,
    hint: str,
    parse: Callable[[str], Any] = json.loads,
    max_bytes: int = _MAX_DOCUMENT_BYTES,
) -> Any:
    """Return the value of a file of JSON, TOML or YAML that may come from anybody.

    Args:
        path: The file.
        content: What the file holds, for the error: "a report of a map".
        hint: What to do if it holds something else.
        parse: Returns the value of a text, or raises ValueError.
        max_bytes: Of the file.

    Raises:
        UsageError: The file cannot be read, is too long, or is not what *parse* takes.
    """
    try:
        return parse(read_regular_file(path, max_bytes).decode())
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}", hint=hint) from error
    except (ValueError, RecursionError, MemoryError) as error:
        raise UsageError(f"{path} is not {content}: {error}", hint=hint) from error


def read_private_file(path: Path, content: str, *, hint: str) -> bytes:
    """Return the first MiB of a file that only its owner can read.

    Args:
        path: The file; a pipe or a device reads as empty.
        content: What the file holds, for the error: "the key".
        hint: What to do if the file cannot be read.

    Raises:
        UsageError: The file cannot be read, or others than its owner can read it, too.
    """
    try:
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            data = file.read(_MAX_BYTES) if stat.S_ISREG(mode) else b""
    except OSError as error:
        raise UsageError(f"cannot read {content} {path}: {error.strerror}", hint=hint) from error
    if stat.S_IMODE(mode) & _OTHERS:
        raise UsageError(f"others may read {content} {path}", hint=f"chmod 600 {path}")
    return data


def sync_folder(folder: Path | str) -> None:
    """Make the names in *folder* survive a power failure."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _write(handle: int, data: bytes | str, is_durable: bool) -> None:
    try:
        view = memoryview(data.encode() if isinstance(data, str) else data)
        while view:
            view = view[os.write(handle, view) :]
        if is_durable:
            os.fsync(handle)
    finally:
        os.close(handle)
