"""The services folder of a server that runs what operators publish: unpacked, checked, and changed at once.

A server reads the folder through the link ``current``.  A new list gets a folder of its own beside the former
one, and the link moves when all of it is checked, so that a server which still reads the former one is not
disturbed and a machine that fails in the middle keeps it.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import os
import shutil
import tarfile
import tempfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath

from rse_pf.object_store import digest_of
from rse_pf.services.custom.installed import DEPENDENCIES_FOLDER, InstalledService, installed_services
from rse_pf.services.custom.publishing import MAX_ARCHIVE_BYTES, PublishedService, damaged, decode_list

__all__ = ["CURRENT", "PublishedFolder", "assemble", "unpack"]

CURRENT = "current"
"""The link to the folder of services that run."""
_ARCHIVES, _LISTS = "archives", "lists"
_MAX_UNPACKED_BYTES, _MAX_FILES = 1 << 30, 20_000
_MAX_PATH, _MAX_PART = 2000, 200
_DAMAGES = (
    tarfile.TarError, EOFError, zlib.error, gzip.BadGzipFile, FileExistsError, NotADirectoryError, ValueError
)  # fmt: skip
"""What an archive can cause; a full disk is another error, after which the same list is tried again."""


class PublishedFolder:
    """``current``, the folders of the lists, and the unpacked archives, below one root."""

    def __init__(self, root: Path) -> None:
        """Read and write nothing yet."""
        self._root = root

    @property
    def link(self) -> Path:
        """What a server follows."""
        return self._root / CURRENT

    def holds(self, data: bytes) -> bool:
        """Return whether the list *data* is the one that runs."""
        return self.link.is_dir() and self.link.resolve().name == _name_of(data)

    def install(self, data: bytes, fetch: Callable[[PublishedService], bytes]) -> list[InstalledService]:
        """Let ``current`` lead to the services of the list *data*, and return them.

        Args:
            data: As `decode_list` takes it.
            fetch: Returns an archive; called for those that are not here yet.

        Raises:
            ConfigurationError: The list or an archive is refused; ``current`` stays.
            StoreError: An archive cannot be fetched; ``current`` stays.
        """
        entries = decode_list(data).services
        archives, target = self._root / _ARCHIVES, self._root / _LISTS / _name_of(data)
        for folder in (archives, target.parent):
            folder.mkdir(parents=True, exist_ok=True)
        for entry in entries:
            if not (archives / entry.archive).is_dir():
                if entry.size > MAX_ARCHIVE_BYTES:
                    raise damaged(f"the archive of {entry.name} is {entry.size} bytes")
                fresh = Path(tempfile.mkdtemp(prefix=".new-", dir=archives))
                try:
                    unpack(entry, fetch(entry), fresh)
                    fresh.rename(archives / entry.archive)
                finally:
                    shutil.rmtree(fresh, ignore_errors=True)
        shutil.rmtree(target, ignore_errors=True)
        found = assemble(entries, archives, target)
        former = self.link.resolve() if self.link.is_dir() else target
        self._point(target)
        self._forget_all_but({target.name, former.name}, {entry.archive for entry in entries})
        return found

    def _point(self, target: Path) -> None:
        fresh = self._root / ".new-current"
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(target.relative_to(self._root))
        fresh.replace(self.link)

    def _forget_all_but(self, lists: set[str], archives: set[str]) -> None:
        """Remove what no server reads any more; a file that is linked from a list stays there."""
        for folder, kept in ((_LISTS, lists), (_ARCHIVES, archives)):
            for each in (self._root / folder).iterdir():
                if each.name not in kept:
                    shutil.rmtree(each, ignore_errors=True)


def unpack(entry: PublishedService, archive: bytes, into: Path) -> None:
    """Write the files of *archive* below *into*, which must be empty or missing.

    Raises:
        ConfigurationError: The archive is not the one that *entry* names, or holds what no archive of
            `archive_of` holds: links, paths that leave the folder, or too much.
    """
    if digest_of(archive) != entry.archive:
        raise damaged(f"the archive of {entry.name} is not the one in the list")
    into.mkdir(parents=True, exist_ok=True)
    files = size = 0
    try:
        with tarfile.open(fileobj=io.BytesIO(archive), mode="r:gz") as packed:
            for member in packed:
                parts = PurePosixPath(member.name).parts
                files, size = files + 1, size + member.size
                if not member.isreg() or not parts or parts[0] not in (entry.name, DEPENDENCIES_FOLDER):
                    raise damaged(f"the archive of {entry.name} holds {member.name[:80]!r}")
                if len(os.fsencode(member.name)) > _MAX_PATH or max(map(len, parts)) > _MAX_PART:
                    raise damaged(f"the archive of {entry.name} holds a name that is too long")
                if ".." in parts or files > _MAX_FILES or size > _MAX_UNPACKED_BYTES:
                    raise damaged(f"the archive of {entry.name} leaves its folder, or is too large")
                target = into.joinpath(*parts)
                target.parent.mkdir(parents=True, exist_ok=True)
                content = packed.extractfile(member)
                assert content is not None
                with target.open("xb") as file:
                    shutil.copyfileobj(content, file)
                target.chmod(0o644)
    except _DAMAGES as error:
        raise damaged(f"the archive of {entry.name} cannot be read: {error}") from error


def assemble(entries: Sequence[PublishedService], unpacked: Path, into: Path) -> list[InstalledService]:
    """Make the services folder *into* from the unpacked archives of *entries*, and return its services.

    Files are linked, not copied.  *into* appears when all of it is checked, and must not exist.

    Raises:
        ConfigurationError: A file is not as it was published, or two services cannot run together.
    """
    fresh = Path(tempfile.mkdtemp(prefix=".new-", dir=into.parent))
    try:
        for entry in entries:
            shutil.copytree(unpacked / entry.archive, fresh, copy_function=_link, dirs_exist_ok=True)
        found = installed_services(fresh)
        if [(each.name, each.identity) for each in found] != [(each.name, each.identity) for each in entries]:
            raise damaged("the archives do not hold the services of the list")
        for folder in (fresh, *(path for path in fresh.rglob("*") if path.is_dir())):
            folder.chmod(0o755)  # a sandbox may have a user of its own
        fresh.rename(into)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return installed_services(into)


def _link(source: str, target: str) -> None:
    if not os.path.exists(target):  # packages that two services share
        os.link(source, target)


def _name_of(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]
