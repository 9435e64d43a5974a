"""Publish services to all servers of a platform on AWS, and follow what was published.

An operator uploads an archive of each service, and a list of the services that run, to the artifact bucket.
The list names each archive by its SHA-256, so a server runs only what the list names.  By the permissions on
the bucket, operators may write archives and list, and servers may only read them.  A server unpacks the
archives into a `PublishedFolder`, which it uses as its services folder.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import os
import re
import shutil
import tarfile
import tempfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath

import msgspec

from rse_pf.config.resource_names import SERVICES_PREFIX
from rse_pf.errors import ConfigurationError, Conflict, NotFound, StoreError, UsageError
from rse_pf.services.custom.dependencies import SHA256_PATTERN, Dependencies, require_same_versions
from rse_pf.services.custom.installed import (
    DEPENDENCIES_FOLDER,
    NAME_PATTERN,
    InstalledService,
    installed_services,
    read_dependencies,
)
from rse_pf.services.custom.regular_files import list_files, read_regular_file, require_regular_files
from rse_pf.storage.object_store import ObjectStore, digest_of

__all__ = [
    "CURRENT",
    "LIST_NAME",
    "LIST_POLL_PERIOD_S",
    "MAX_ARCHIVE_BYTES",
    "SERVER_PLATFORM",
    "PublishedFolder",
    "PublishedList",
    "PublishedService",
    "archive_name",
    "assemble_folder",
    "damaged_error",
    "decode_list",
    "pack_archive",
    "publish",
    "read_list",
    "require_server_platform",
    "unpack_archive",
    "unpublish",
]

LIST_NAME = f"{SERVICES_PREFIX}/list.json"
"""Name of the list in the artifact bucket."""
LIST_POLL_PERIOD_S = 15
"""Seconds between two reads of the list by a server: every server begins to install a new list within this
time."""
SERVER_PLATFORM = "cp311-linux-x86_64"
"""Platform tag of servers on AWS, which run Debian 12 on x86-64; packages of services must have the same
tag."""
MAX_ARCHIVE_BYTES = 128 << 20
"""Largest archive of a service in bytes, compressed; a larger one is neither published nor installed.  Larger
data, such as models, belong to the object store."""
CURRENT = "current"
"""Name of the link in a `PublishedFolder` that leads to the services folder that runs."""

# --- The folders of a PublishedFolder ---
_ARCHIVES = "archives"  # folder of the unpacked archives, each named by its digest
_LISTS = "lists"  # folder of the services folders, each named by the digest of its list

# --- Limits of an archive, above which it is refused while it is unpacked ---
_MAX_UNPACKED_BYTES = 1 << 30  # largest total size of the files in bytes, so that a bomb cannot fill the disk
_MAX_FILES = 20_000  # largest number of files
_MAX_PATH = 2000  # largest number of bytes of a file's path within the archive
_MAX_PART = 200  # largest number of characters of one name in a path, below the limit of file systems
_ARCHIVE_ERRORS = (
    tarfile.TarError,
    EOFError,
    zlib.error,
    gzip.BadGzipFile,
    FileExistsError,
    NotADirectoryError,
    ValueError,
)
"""Errors that a damaged archive causes, which become a ConfigurationError: a server does not try to install
this list again.  Other errors, such as that of a full disk, are raised as they are, and the server tries to
install the list again at its next poll."""

_MAX_TRIES = 8  # attempts to replace the list of services while other operators publish; then StoreError

# --- What the shared libraries of a service may need ---
_ELF_MAGIC = b"\x7fELF\x02\x01"  # first bytes of a 64-bit little-endian ELF file
_ELF_MACHINE = slice(18, 20)  # bytes of an ELF header that hold the machine, little-endian
_ELF_X86_64 = 62  # the machine x86-64 in an ELF header
_SYMBOL_VERSION = re.compile(rb"\b(GLIBC|GLIBCXX)_(\d+)\.(\d+)(?:\.(\d+))?\b")
"""The name of a symbol version in a shared library, such as ``GLIBC_2.34``."""
_NEWEST_VERSIONS = {b"GLIBC": (2, 36, 0), b"GLIBCXX": (3, 4, 30)}
"""Newest symbol versions (major, minor, patch) of the C and C++ libraries of Debian 12.  A service whose
library needs a newer one is not published, since no server could load it."""
_BUILD_HINT = "build it on Debian 12 (x86-64), for example in a container, and publish from there"


class PublishedService(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An entry of the list: a service with the digest of its archive.

    Attributes:
        name: Name of the service.
        language: ``python``, ``cpp`` or ``lua``.
        archive: SHA-256 of the archive in hexadecimal digits.
        size: Size of the archive in bytes.
        identity: `InstalledService.identity` of the service in the archive.
        published_s: Unix time of the publication in seconds.
        packages: Versions of the service's Python packages by name.
    """

    name: str
    language: str
    archive: str
    size: int
    identity: str
    published_s: float
    packages: dict[str, str] = {}


class PublishedList(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The services that all servers run, sorted by name."""

    services: tuple[PublishedService, ...] = ()


def decode_list(data: bytes) -> PublishedList:
    """Return the list that *data* encodes as JSON.

    Raises:
        ConfigurationError: The list is damaged: it is not JSON, a name is invalid, occurs twice or is out of
            order, or an archive is not named by a SHA-256.
    """
    try:
        published = msgspec.json.decode(data, type=PublishedList)
    except msgspec.MsgspecError as error:
        raise damaged_error(f"{LIST_NAME} is not a list of services: {error}") from error
    names = [entry.name for entry in published.services]
    digests = [entry.archive for entry in published.services]
    if names != sorted(set(names)) or not all(map(NAME_PATTERN.fullmatch, names)):
        raise damaged_error(f"{LIST_NAME} names a service twice, out of order, or by an invalid name")
    if not all(map(SHA256_PATTERN.fullmatch, digests)):
        raise damaged_error(f"{LIST_NAME} names an archive without its digest")
    return published


def read_list(store: ObjectStore) -> PublishedList:
    """Return the list in *store*; an empty list if nothing was published.

    Raises:
        ConfigurationError: The list is damaged.
    """
    return _read(store)[1]


def publish(service: InstalledService, root: Path, store: ObjectStore, *, now_s: float) -> PublishedService:
    """Upload the archive of a service, and put the service into the list; it replaces one of the same name.

    Args:
        service: The service.
        root: A services folder that holds only *service* and its packages.
        store: The artifact bucket.
        now_s: Unix time, seconds.

    Raises:
        ConfigurationError: Servers cannot run the service, the archive is too large, the published list is
            damaged, or another published service needs another version of a package.
        UsageError: An entry below *root* is neither a regular file nor a folder.
        StoreError: The store fails, or other operators change the list during each attempt to replace it;
            the list stays.
    """
    dependencies = require_server_platform(service, root)
    archive = pack_archive(root)
    if len(archive) > MAX_ARCHIVE_BYTES:
        raise ConfigurationError(
            f"{service.name} is {len(archive)} bytes, above {MAX_ARCHIVE_BYTES}",
            hint="publish fewer files, or put models into the object store",
        )
    entry = PublishedService(
        name=service.name,
        language=service.language,
        archive=digest_of(archive),
        size=len(archive),
        identity=service.identity,
        published_s=now_s,
        packages={} if dependencies is None else dict(dependencies.packages),
    )
    store.put(archive_name(entry.archive), archive)
    _change_list(store, {entry.name: entry})
    return entry


def unpublish(name: str, store: ObjectStore) -> None:
    """Remove the service *name* from the list; its archive stays until a rule of the bucket deletes it.

    Raises:
        UsageError: The list has no service of this name.
    """
    published = [entry.name for entry in read_list(store).services]
    if name not in published:
        raise UsageError(
            f"no service {name!r} is published", hint=f"published are: {', '.join(published) or 'none'}"
        )
    _change_list(store, {name: None})


def require_server_platform(service: InstalledService, root: Path) -> Dependencies | None:
    """Check the platform of the packages and shared libraries of *service* in the services folder *root*.

    Returns:
        The Python packages of the service, None if it has none.

    Raises:
        ConfigurationError: Packages or shared libraries are for another platform, or need a newer C library.
    """
    dependencies = read_dependencies(root / service.name)
    if dependencies is not None and dependencies.platform != SERVER_PLATFORM:
        raise ConfigurationError(
            f"the packages of {service.name} are for {dependencies.platform}, servers are {SERVER_PLATFORM}",
            hint="publish with Python 3.11 on Linux (x86-64)",
        )
    for path in list_files(root):
        if re.search(r"\.so(\.\d+)*$", path.name):
            _require_loadable_library(service.name, path)
    return dependencies


def pack_archive(root: Path) -> bytes:
    """Return all files below *root* as a gzip-compressed tar archive; equal files give equal bytes.

    Times, owners and modes of the files are not kept, and empty folders are left out.

    Raises:
        UsageError: An entry below *root* is neither a regular file nor a folder.
    """
    require_regular_files(root)
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for path in list_files(root):
            content = read_regular_file(path)
            member = tarfile.TarInfo(path.relative_to(root).as_posix())
            member.size, member.mode = len(content), 0o644
            archive.addfile(member, io.BytesIO(content))
    return gzip.compress(packed.getvalue(), compresslevel=6, mtime=0)


def _read(store: ObjectStore) -> tuple[bytes | None, PublishedList]:
    try:
        data = store.get(LIST_NAME)
    except NotFound:
        return None, PublishedList()
    return data, decode_list(data)


def _change_list(store: ObjectStore, changes: Mapping[str, PublishedService | None]) -> None:
    """Apply *changes* to the list in *store* by compare-and-swap.

    Args:
        store: The artifact bucket.
        changes: For each name of a service its new entry, or None to remove the service.

    Raises:
        ConfigurationError: The list is damaged, or two services would need different versions of a package.
        StoreError: The list was changed by others at each of `_MAX_TRIES` attempts.
    """
    for _ in range(_MAX_TRIES):
        before, published = _read(store)
        merged = {**{entry.name: entry for entry in published.services}, **changes}
        entries = tuple(entry for _, entry in sorted(merged.items()) if entry is not None)
        require_same_versions({entry.name: entry.packages for entry in entries})
        try:
            store.compare_and_swap(LIST_NAME, before, msgspec.json.encode(PublishedList(services=entries)))
        except Conflict:
            continue
        return
    raise StoreError(
        f"other operators changed the list of services during each of {_MAX_TRIES} attempts to replace it",
        hint="publish again",
    )


def _require_loadable_library(service: str, path: Path) -> None:
    """Raise ConfigurationError if the shared library *path* certainly cannot be loaded on Debian 12 (x86-64).

    The library must be an ELF file for x86-64, and must not contain the name of a symbol version that is
    newer than the C and C++ libraries of Debian 12.  Whether other libraries that it needs exist is not
    checked.
    """
    data = path.read_bytes()
    if not data.startswith(_ELF_MAGIC) or int.from_bytes(data[_ELF_MACHINE], "little") != _ELF_X86_64:
        raise ConfigurationError(
            f"{path.name} of {service} is not a library for x86-64, the processor of the servers",
            hint=_BUILD_HINT,
        )
    for library, major, minor, patch in set(_SYMBOL_VERSION.findall(data)):
        needed = (int(major), int(minor), int(patch or 0))
        if needed > _NEWEST_VERSIONS[library]:
            version = ".".join(map(str, needed if patch else needed[:2]))
            raise ConfigurationError(
                f"{path.name} of {service} needs {library.decode()}_{version}, Debian 12 has an older one",
                hint=_BUILD_HINT,
            )


def archive_name(digest: str) -> str:
    """Return the object name of the archive whose SHA-256 in hexadecimal digits is *digest*."""
    return f"{SERVICES_PREFIX}/archives/{digest}"


def damaged_error(message: str) -> ConfigurationError:
    """Return the error for published data that `publish` did not write."""
    return ConfigurationError(message, hint="publish the services again with: rse-pf service publish FOLDER")


class PublishedFolder:
    """The services folder of a server that follows the published list.

    Below one root lie the unpacked archives, a services folder for each list, and the link ``current`` to the
    services folder that runs.  A new list gets a new services folder, and the link moves after all files of
    that folder are verified.  So a process of the server that still reads the old services folder is not
    disturbed, and if an installation fails, the link leads to the old services.
    """

    def __init__(self, root: Path) -> None:
        """Remember the folder *root*; the first `install` creates it."""
        self._root = root

    @property
    def link(self) -> Path:
        """Path of the link ``current``, which a server uses as its services folder."""
        return self._root / CURRENT

    def holds(self, data: bytes) -> bool:
        """Return whether the link leads to the services of the encoded list *data*; False without a link."""
        return self.link.is_dir() and self.link.resolve().name == _folder_name(data)

    def install(self, data: bytes, fetch: Callable[[PublishedService], bytes]) -> list[InstalledService]:
        """Move the link ``current`` to the services of the list *data*, and return them.

        Args:
            data: Encoded list, as `decode_list` reads it.
            fetch: Function that returns the archive of a service; called for archives that are not unpacked
                yet.

        Raises:
            ConfigurationError: The list or an archive is damaged, or two services need different versions of
                a package; the link stays.
            StoreError: An archive cannot be fetched; the link stays.
        """
        entries = decode_list(data).services
        archives, target = self._root / _ARCHIVES, self._root / _LISTS / _folder_name(data)
        for folder in (archives, target.parent):
            folder.mkdir(parents=True, exist_ok=True)
        # 1. Fetch and unpack the archives that are not unpacked yet, each under a temporary name.
        for entry in entries:
            if not (archives / entry.archive).is_dir():
                if entry.size > MAX_ARCHIVE_BYTES:
                    raise damaged_error(
                        f"the archive of {entry.name} is {entry.size} bytes, above {MAX_ARCHIVE_BYTES}"
                    )
                fresh = Path(tempfile.mkdtemp(prefix=".new-", dir=archives))
                try:
                    unpack_archive(entry, fetch(entry), fresh)
                    fresh.rename(archives / entry.archive)
                finally:
                    shutil.rmtree(fresh, ignore_errors=True)
        # 2. Make the services folder of the list from the archives, and compare all files with their hashes.
        shutil.rmtree(target, ignore_errors=True)
        services = assemble_folder(entries, archives, target)
        # 3. Move the link ``current`` to the new services folder.
        former = self.link.resolve() if self.link.is_dir() else target
        self._move_link(target)
        # 4. Remove all services folders but the new and the former one, which a server may still read, and
        # the archives that the new list does not name.
        self._remove_others({target.name, former.name}, {entry.archive for entry in entries})
        return services

    def _move_link(self, target: Path) -> None:
        fresh = self._root / ".new-current"
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(target.relative_to(self._root))
        fresh.replace(self.link)

    def _remove_others(self, lists: set[str], archives: set[str]) -> None:
        """Remove all but the named services folders and archives.

        A services folder that is kept loses no file of a removed archive, because it has hard links to the
        files.
        """
        for folder, keep in ((_LISTS, lists), (_ARCHIVES, archives)):
            for path in (self._root / folder).iterdir():
                if path.name not in keep:
                    shutil.rmtree(path, ignore_errors=True)


def unpack_archive(entry: PublishedService, archive: bytes, into: Path) -> None:
    """Write the files of *archive* below *into*, which must be empty or missing.

    Files that were written before an error stay; the caller removes them.

    Raises:
        ConfigurationError: The digest of the archive is not that of *entry*, or the archive holds what no
            archive of `pack_archive` does: links, paths that leave the folder, too many or too large files.
    """
    if digest_of(archive) != entry.archive:
        raise damaged_error(f"the archive of {entry.name} is not the one in the list")
    into.mkdir(parents=True, exist_ok=True)
    files = size = 0
    try:
        with tarfile.open(fileobj=io.BytesIO(archive), mode="r:gz") as packed:
            for member in packed:
                parts = PurePosixPath(member.name).parts
                files, size = files + 1, size + member.size
                if not member.isreg() or not parts or parts[0] not in (entry.name, DEPENDENCIES_FOLDER):
                    raise damaged_error(
                        f"the archive of {entry.name} holds {member.name[:80]!r}, which is no regular file "
                        f"or lies outside of {entry.name} and {DEPENDENCIES_FOLDER}"
                    )
                if len(os.fsencode(member.name)) > _MAX_PATH or max(map(len, parts)) > _MAX_PART:
                    raise damaged_error(f"the archive of {entry.name} holds a name that is too long")
                if ".." in parts or files > _MAX_FILES or size > _MAX_UNPACKED_BYTES:
                    raise damaged_error(f"the archive of {entry.name} leaves its folder, or is too large")
                target = into.joinpath(*parts)
                target.parent.mkdir(parents=True, exist_ok=True)
                content = packed.extractfile(member)
                assert content is not None
                with target.open("xb") as file:
                    shutil.copyfileobj(content, file)
                target.chmod(0o644)
    except _ARCHIVE_ERRORS as error:
        raise damaged_error(f"the archive of {entry.name} cannot be read: {error}") from error


def assemble_folder(
    entries: Sequence[PublishedService], unpacked: Path, into: Path
) -> list[InstalledService]:
    """Make a services folder of unpacked archives by hard links, and return its services.

    Args:
        entries: Services of the list.
        unpacked: Folder of the unpacked archives, each named by its digest.
        into: Path of the new folder, which must not exist; it appears once all services are verified.

    Raises:
        ConfigurationError: A file is not as it was published, or two services need different versions of a
            package.
    """
    fresh = Path(tempfile.mkdtemp(prefix=".new-", dir=into.parent))
    try:
        for entry in entries:
            shutil.copytree(unpacked / entry.archive, fresh, copy_function=_link, dirs_exist_ok=True)
        services = installed_services(fresh)
        listed = [(entry.name, entry.identity) for entry in entries]
        if [(service.name, service.identity) for service in services] != listed:
            raise damaged_error("the archives do not hold the services of the list")
        for folder in (fresh, *(path for path in fresh.rglob("*") if path.is_dir())):
            folder.chmod(0o755)  # Sandboxes may run as another user.
        fresh.rename(into)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    return installed_services(into)


def _link(source: str, target: str) -> None:
    if not os.path.exists(target):  # Two services may share packages.
        os.link(source, target)


def _folder_name(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]
