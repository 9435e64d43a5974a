"""Read and write small files: files that are replaced in one step, and private files that hold a secret.

A reader of a file that is being replaced gets the old content or the new one, never a mixture.
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
"""Mode of a file that holds a secret: only its user may read and write it."""
TEMPORARY_PREFIX = ".part-"
"""Prefix of the names of temporary files; a writer that is killed leaves its file behind."""
_BY_UMASK = 0o666  # mode of a file without a secret, from which the bits of the umask are removed
_OTHERS = 0o077  # bits of a mode that give permissions to other users
_MAX_BYTES = 1 << 20  # bytes that are read of a file with a secret: none is longer
_MAX_DOCUMENT_BYTES = 16 << 20  # bytes of a document that is read as a whole; a longer one is refused


def check_exists(path: Path | str, hint: str) -> None:
    """Raise UsageError with *hint* if nothing exists at *path*; name the first parent that is missing."""
    path = Path(path)
    missing = [each for each in (path, *path.parents) if not each.exists()]
    if missing:
        where = f": there is no folder {missing[-1]}" if len(missing) > 1 else ""
        raise UsageError(f"{path} does not exist{where}", hint=hint)


def replace_file(
    path: Path | str, data: bytes | str, *, mode: int = _BY_UMASK, is_durable: bool = False
) -> None:
    """Replace the file *path* by a file with the content *data* in one step, or create it.

    Args:
        path: The file; its folder must exist.
        data: The whole content; text is written as UTF-8.
        mode: Permissions of the new file, without the bits of the umask.
        is_durable: Whether content and name survive a power failure after this function returned.

    Raises:
        OSError: The file cannot be written; an existing file is not changed.
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
    """Replace the file *path* by *value* as JSON in one step; raises OSError as `replace_file`."""
    replace_file(path, json.dumps(value, indent=indent))


def create_private_file(path: Path, text: str) -> None:
    """Write *text* to a new file that only this user can read, and sync its content to the disk.

    Raises:
        OSError: The file cannot be written, or exists already (FileExistsError).
    """
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, OWNER_ONLY)
    _write(handle, text, True)


def read_regular_file(path: Path, max_bytes: int) -> bytes:
    """Return the content of the file *path*, which may come from somebody who is not trusted.

    Raises:
        OSError: The file cannot be read, is no regular file (a pipe or a device), or is longer than
            *max_bytes*.
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
    """Return the parsed value of a JSON, TOML or YAML file that may come from somebody who is not trusted.

    Args:
        path: The file.
        content: What the file should hold, for the message of the error: "a report of a map".
        hint: Hint of each error.
        parse: Returns the value of the text of the file, or raises ValueError.
        max_bytes: Largest size of the file.

    Raises:
        UsageError: The file cannot be read, is longer than *max_bytes*, or *parse* refuses its text.
    """
    try:
        return parse(read_regular_file(path, max_bytes).decode())
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}", hint=hint) from error
    except (ValueError, RecursionError, MemoryError) as error:
        raise UsageError(f"{path} is not {content}: {error}", hint=hint) from error


def read_private_file(path: Path, content: str, *, hint: str) -> bytes:
    """Return the content (at most 1 MiB) of a file that only its user may read, because it holds a secret.

    Args:
        path: The file; for a pipe or a device the result is empty.
        content: What the file holds, for the message of the error: "the key".
        hint: Hint of the error if the file cannot be read.

    Raises:
        UsageError: The file cannot be read, or its mode gives other users a permission.
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
    """Sync *folder* to the disk, so that the names of its files survive a power failure; raises OSError."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _write(handle: int, data: bytes | str, is_durable: bool) -> None:
    """Write *data* to the descriptor *handle*, sync it if *is_durable*, and close it in any case."""
    try:
        view = memoryview(data.encode() if isinstance(data, str) else data)
        while view:
            view = view[os.write(handle, view) :]
        if is_durable:
            os.fsync(handle)
    finally:
        os.close(handle)
