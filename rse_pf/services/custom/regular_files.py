"""Read and copy the folder of a service without following links or opening pipes and devices.

The author of a service is not trusted: a link could name any file that the operator may read, and to open a
pipe or a device could block for ever.
"""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Collection, Iterator
from pathlib import Path

from rse_pf.errors import UsageError

__all__ = ["copy_regular_files", "list_files", "read_regular_file", "require_regular_files"]

_OPEN_FLAGS = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
"""Flags to open a file that may be replaced after it was checked: links are refused, and a pipe does not
block."""
_REFUSED_KINDS = (
    (stat.S_ISLNK, "a link", "put the file itself into the folder"),
    (stat.S_ISFIFO, "a pipe", "remove it"),
    (stat.S_ISSOCK, "a socket", "remove it"),
    (stat.S_ISCHR, "a device", "remove it"),
    (stat.S_ISBLK, "a device", "remove it"),
)
"""Kinds of entries that no service may have: the function that recognises the mode of a file, and the name of
the kind and the hint for the error."""


def read_regular_file(path: Path) -> bytes:
    """Return the content of the regular file *path*.

    Raises:
        UsageError: The path is a link, a folder, a pipe, a socket or a device.
        OSError: The file is missing, or must not be read.
    """
    _check(path, path.lstat().st_mode, may_be_folder=False)
    with open(os.open(path, _OPEN_FLAGS), "rb") as file:
        _check(path, os.fstat(file.fileno()).st_mode, may_be_folder=False)
        return file.read()


def list_files(folder: Path) -> Iterator[Path]:
    """Yield the paths of all regular files and links below *folder*, sorted."""
    for path in sorted(folder.rglob("*")):
        if path.is_file() or path.is_symlink():
            yield path


def require_regular_files(folder: Path, ignored: Collection[str] = ()) -> None:
    """Check that everything below *folder* is a regular file or a folder.

    Args:
        folder: The folder.
        ignored: Names of files and folders that are not looked at, at every level.

    Raises:
        UsageError: An entry is a link, a pipe, a socket or a device.
    """
    with os.scandir(folder) as entries:
        for entry in sorted(entries, key=lambda entry: entry.name):
            if entry.name not in ignored:
                path = folder / entry.name
                mode = path.lstat().st_mode
                _check(path, mode, may_be_folder=True)
                if stat.S_ISDIR(mode):
                    require_regular_files(path, ignored)


def copy_regular_files(folder: Path, into: Path, ignored: Collection[str] = ()) -> None:
    """Copy the regular files below *folder* to the new folder *into*, with their modes and times.

    Args:
        folder: The folder; the path itself may be a link, since the operator named it.
        into: Path of the copy, which must not exist.
        ignored: Names of files and folders that are not copied, at every level.

    Raises:
        UsageError: An entry is a link, a pipe, a socket or a device.
    """
    into.mkdir()
    for path, names, files, at in os.fwalk(os.path.realpath(folder)):
        names[:] = [name for name in names if name not in ignored]
        target = into / os.path.relpath(path, os.path.realpath(folder))
        for name in (*names, *files):
            if name in ignored:
                continue
            mode = os.stat(name, dir_fd=at, follow_symlinks=False).st_mode
            _check(Path(path, name), mode, may_be_folder=True)
            if stat.S_ISDIR(mode):
                (target / name).mkdir()
            else:
                _copy(Path(path, name), name, at, target / name)


def _copy(path: Path, name: str, at: int, target: Path) -> None:
    with open(os.open(name, _OPEN_FLAGS, dir_fd=at), "rb") as source, target.open("xb") as copy:
        status = os.fstat(source.fileno())
        # Check again: another file may have taken its place since the folder was listed.
        _check(path, status.st_mode, may_be_folder=False)
        shutil.copyfileobj(source, copy)
        os.fchmod(copy.fileno(), stat.S_IMODE(status.st_mode) & 0o777)
        copy.flush()
        os.utime(copy.fileno(), ns=(status.st_atime_ns, status.st_mtime_ns))


def _check(path: Path, mode: int, *, may_be_folder: bool) -> None:
    if stat.S_ISREG(mode) or (may_be_folder and stat.S_ISDIR(mode)):
        return
    refused = ((kind, hint) for is_kind, kind, hint in _REFUSED_KINDS if is_kind(mode))
    kind, hint = next(refused, ("a folder", "remove it"))
    raise UsageError(f"{path} is {kind}, and a service consists of regular files only", hint=hint)
