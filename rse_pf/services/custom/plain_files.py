"""Files of a folder that a stranger wrote: regular files alone are read and copied, no link is followed.

A link could name any file that the operator may read, and a pipe or a device could block for ever.
"""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Collection
from pathlib import Path

from rse_pf.errors import UsageError

__all__ = ["check_plain", "copy_plain", "read_plain"]

_OPEN = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
"""A pipe that took the place of a file does not block."""
_KINDS = (
    (stat.S_ISLNK, "a link", "put the file itself into the folder"),
    (stat.S_ISFIFO, "a pipe", "remove it"),
    (stat.S_ISSOCK, "a socket", "remove it"),
    (stat.S_ISCHR, "a device", "remove it"),
    (stat.S_ISBLK, "a device", "remove it"),
)


def read_plain(path: Path) -> bytes:
    """Return the content of the regular file *path*.

    Raises:
        UsageError: It is a link, or no file.
        OSError: It is missing, or may not be read.
    """
    _check(path, path.lstat().st_mode, may_be_folder=False)
    with open(os.open(path, _OPEN), "rb") as file:
        _check(path, os.fstat(file.fileno()).st_mode, may_be_folder=False)
        return file.read()


def check_plain(folder: Path, ignored: Collection[str] = ()) -> None:
    """Check that everything below *folder* but what is named in *ignored* is a regular file or a folder.

    Raises:
        UsageError: Something is a link, a pipe, a socket or a device.
    """
    with os.scandir(folder) as entries:
        for entry in sorted(entries, key=lambda each: each.name):
            if entry.name not in ignored:
                path = folder / entry.name
                mode = path.lstat().st_mode
                _check(path, mode, may_be_folder=True)
                if stat.S_ISDIR(mode):
                    check_plain(path, ignored)


def copy_plain(folder: Path, into: Path, ignored: Collection[str] = ()) -> None:
    """Copy the regular files below *folder* to the new folder *into*, with their mode and time.

    Args:
        folder: May itself be reached through a link: its user named it.
        into: Must not exist.
        ignored: Names of files and folders that are left out, at every level.

    Raises:
        UsageError: Something is a link, a pipe, a socket or a device.
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
    with open(os.open(name, _OPEN, dir_fd=at), "rb") as source, target.open("xb") as copy:
        about = os.fstat(source.fileno())
        _check(path, about.st_mode, may_be_folder=False)  # it may have changed since it was listed
        shutil.copyfileobj(source, copy)
        os.fchmod(copy.fileno(), stat.S_IMODE(about.st_mode) & 0o777)
        copy.flush()
        os.utime(copy.fileno(), ns=(about.st_atime_ns, about.st_mtime_ns))


def _check(path: Path, mode: int, *, may_be_folder: bool) -> None:
    if stat.S_ISREG(mode) or (may_be_folder and stat.S_ISDIR(mode)):
        return
    what, hint = next(((what, hint) for test, what, hint in _KINDS if test(mode)), ("a folder", "remove it"))
    raise UsageError(f"{path} is {what}, and a service is regular files alone", hint=hint)
