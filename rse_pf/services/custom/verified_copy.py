"""Private copies of installed services for sandboxes, so that the verified bytes are the bytes that run.

A server compares the files of a service with their hashes when it starts, and a sandbox may load them hours
later.  The zygote, which is the parent process of all sandboxes, therefore copies the files to a folder of
its own.  It compares the copy with the hashes in ``pins.json``, and ``pins.json`` with the identity
(`InstalledService.identity`) that the server read when it started.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import stat
import tempfile
from pathlib import Path

from rse_pf.errors import ConfigurationError, RsePfError
from rse_pf.services.custom.dependencies import copy_dependencies
from rse_pf.services.custom.installed import (
    DEPENDENCIES_FOLDER,
    InstalledService,
    read_dependencies,
    read_identity,
    verify_installed,
)
from rse_pf.services.custom.regular_files import copy_regular_files

__all__ = ["PrivateFolder", "VerifiedCopy"]

_PREFIX = "rse-pf-services-"
"""Start of the names of private folders, by which abandoned ones are found."""
_FileStatus = tuple[int, int, int, int]
"""Inode, size, and times at which content and attributes of a file changed, in nanoseconds."""


class PrivateFolder:
    """A temporary folder that its process locks, so that the next process can remove abandoned ones."""

    def __init__(self, parent: Path) -> None:
        """Prepare a folder below *parent*; `make` creates it."""
        self._parent = parent
        self._lock = -1
        self.path: Path | None = None

    def make(self) -> Path:
        """Create the folder and return its path, after the removal of folders whose processes were killed."""
        self._remove_abandoned()
        while self.path is None:
            path = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=self._parent))
            self._lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            fcntl.flock(self._lock, fcntl.LOCK_SH)
            if path.exists():
                self.path = path
            else:
                # Another process removed the folder as abandoned before it was locked: try again.
                os.close(self._lock)
        return self.path

    def remove(self) -> None:
        """Remove the folder with its content; do nothing if it was not created."""
        if self.path is not None:
            shutil.rmtree(self.path, ignore_errors=True)
            os.close(self._lock)
            self.path = None

    def _remove_abandoned(self) -> None:
        for path in self._parent.glob(f"{_PREFIX}*"):
            try:
                status = path.lstat()
                if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
                    continue
                lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            except OSError:
                continue  # Its own process has removed the folder meanwhile.
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(path, ignore_errors=True)
            except BlockingIOError:
                pass  # The process that made the folder still runs: the folder stays.
            finally:
                os.close(lock)


class VerifiedCopy:
    """The private copy of one installed service.

    Attributes:
        original: The service in the services folder.
        service: The service in the copy, once `make` has returned; before, the same as *original*.
    """

    def __init__(self, original: InstalledService, into: Path) -> None:
        """Prepare a copy of *original* below the folder *into*; `make` copies."""
        self.original = original
        self.service = original
        self._into = into
        self._file_statuses: dict[str, _FileStatus] = {}

    def make(self) -> None:
        """Copy the service and its packages, and compare the copy with the hashes; sets ``service``.

        Raises:
            ConfigurationError: The files are not those that the server verified when it started, or cannot be
                copied.
        """
        original = self.original
        file_statuses, target = _file_statuses(original), self._into / original.name
        try:
            copy_regular_files(original.folder, target, ("__pycache__",))
            if read_identity(target) != original.identity:
                raise ConfigurationError(
                    f"{original.name} was installed again while its server started",
                    hint="start the server again; rse-pf local roll replaces the local servers one by one",
                )
            dependencies = read_dependencies(original.folder)
            if dependencies is not None:
                copy_dependencies(dependencies, self._into / DEPENDENCIES_FOLDER)
            self.service = verify_installed(target)
        except OSError as error:
            raise ConfigurationError(
                f"{original.name} cannot be copied: {error}",
                hint="give the temporary folder more space, or install the service again",
            ) from error
        except RsePfError as error:
            raise ConfigurationError(error.message, hint=error.hint) from error
        self._file_statuses = file_statuses

    def problem(self) -> ConfigurationError | None:
        """Return an error if files of *original* were changed after its installation, else None.

        The error names the changed files.  The zygote calls this method before each start of a sandbox, which
        then refuses the service.  If the service was installed again, the result is None: sandboxes load this
        copy until the server is replaced.
        """
        file_statuses = _file_statuses(self.original)
        if file_statuses == self._file_statuses:
            return None
        try:
            if read_identity(self.original.folder) != self.original.identity:
                return None
            verify_installed(self.original.folder)
        except OSError:
            return None  # The service is being removed or replaced.
        except ConfigurationError as error:
            return error
        # The files have other times, but the same bytes: remember the times, so that the next call does not
        # hash the files again.
        self._file_statuses = file_statuses
        return None


def _file_statuses(service: InstalledService) -> dict[str, _FileStatus]:
    """Return the status of each file and link of *service* and its packages, by path.

    The status differs after any change of the file.  Files that are removed meanwhile are left out.
    """
    statuses = {}
    for root in filter(None, (service.folder, service.dependencies)):
        for folder, folders, files in os.walk(root):
            links = (name for name in folders if os.path.islink(os.path.join(folder, name)))
            for name in (*files, *links):
                path = os.path.join(folder, name)
                try:
                    status = os.lstat(path)
                except OSError:
                    continue
                statuses[path] = (status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)
    return statuses
