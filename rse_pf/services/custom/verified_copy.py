"""Copies of installed services that sandboxes load: the bytes whose hash was compared are the bytes that run.

A server compares the pins of a service when it starts, and a sandbox may load it hours later.  So its zygote
copies every file to a folder of its own, and compares the copy.  Nothing of a service is executed here.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import tempfile
from dataclasses import replace
from pathlib import Path

from rse_pf.errors import ConfigurationError, RsePfError
from rse_pf.services.custom.dependencies import check_dependencies, copy_dependencies
from rse_pf.services.custom.installed import (
    DEPENDENCIES_FOLDER,
    InstalledService,
    check_installed,
    dependencies_of,
    identity_of,
)
from rse_pf.services.custom.plain_files import copy_plain

__all__ = ["PrivateFolder", "VerifiedCopy"]

_PREFIX = "rse-pf-services-"
_Mark = tuple[int, int, int, int]
"""Of a file: inode, size, and when content and attributes changed, in nanoseconds."""


class PrivateFolder:
    """A temporary folder that its process holds; one whose process was killed is removed by the next one."""

    def __init__(self, parent: Path) -> None:
        """Remember *parent*, and make nothing."""
        self._parent = parent
        self._lock = -1
        self.path: Path | None = None

    def make(self) -> Path:
        """Make it, and return its path; remove those below the parent that nobody holds."""
        self._remove_abandoned()
        while self.path is None:
            made = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=self._parent))
            self._lock = os.open(made, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            fcntl.flock(self._lock, fcntl.LOCK_SH)
            if made.exists():
                self.path = made
            else:  # another process took it for abandoned before it was locked
                os.close(self._lock)
        return self.path

    def remove(self) -> None:
        """Remove it with its content; one that was not made is no error."""
        if self.path is not None:
            shutil.rmtree(self.path, ignore_errors=True)
            os.close(self._lock)
            self.path = None

    def _remove_abandoned(self) -> None:
        for left in self._parent.glob(f"{_PREFIX}*"):
            try:
                about = left.lstat()
                if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid():
                    continue
                held = os.open(left, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            except OSError:
                continue  # its process removed it meanwhile
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(left, ignore_errors=True)
            except BlockingIOError:
                pass
            finally:
                os.close(held)


class VerifiedCopy:
    """The copy of one installed service; ``service`` leads to it, ``original`` to what was copied."""

    def __init__(self, original: InstalledService, into: Path) -> None:
        """Remember what to copy below *into*, and copy nothing."""
        self.original = original
        self.service = original
        self._into = into
        self._marks: dict[str, _Mark] = {}

    def make(self) -> None:
        """Copy the service and its packages, and compare the copy.

        Raises:
            ConfigurationError: It is not what was installed when the server looked.
        """
        original = self.original
        marks, target = _marks(original), self._into / original.name
        try:
            copy_plain(original.folder, target, ("__pycache__",))
            check_installed(target)
            if identity_of(target) != original.identity:
                raise ConfigurationError(
                    f"{original.name} was installed again while its server started",
                    hint="start the server again, or roll: rse-pf local roll",
                )
            built = dependencies_of(original.folder)
            if built is not None:
                copy_dependencies(built, self._into / DEPENDENCIES_FOLDER)
                built = replace(built, folder=self._into / DEPENDENCIES_FOLDER / built.digest)
                check_dependencies(built, original.name)
        except OSError as error:
            raise ConfigurationError(
                f"{original.name} cannot be copied: {error}",
                hint="give the temporary folder more space, or install the service again",
            ) from error
        except RsePfError as error:
            raise ConfigurationError(error.message, hint=error.hint) from error
        folder = None if built is None else built.folder
        self.service = replace(original, folder=target, dependencies=folder)
        self._marks = marks

    def problem(self) -> ConfigurationError | None:
        """Return how the original was changed since it was installed, None if it was not.

        Another installation in its place is no change: its server runs this copy until it is replaced.
        """
        marks = _marks(self.original)
        if marks == self._marks:
            return None
        try:
            if identity_of(self.original.folder) != self.original.identity:
                return None
            check_installed(self.original.folder)
            built = dependencies_of(self.original.folder)
            if built is not None:
                check_dependencies(built, self.original.name)
        except OSError:
            return None  # it is being removed or replaced
        except ConfigurationError as error:
            return error
        self._marks = marks  # other times, the same bytes
        return None


def _marks(service: InstalledService) -> dict[str, _Mark]:
    """Return what tells that a file of *service* or of its packages may have changed."""
    marks = {}
    for folder in filter(None, (service.folder, service.dependencies)):
        for place, names, files in os.walk(folder):
            for name in (*files, *(each for each in names if os.path.islink(os.path.join(place, each)))):
                path = os.path.join(place, name)
                try:
                    about = os.lstat(path)
                except OSError:
                    continue
                marks[path] = (about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns)
    return marks
