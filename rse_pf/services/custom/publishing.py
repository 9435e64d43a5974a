"""Services that operators publish for all servers: an archive of each, and the list that says which ones run.

An archive is named by its sha256, and the list names archives: a server runs nothing that the list does not
name with its digest.  Only operators may write either; servers read.  Nothing of a service is executed here.
"""

from __future__ import annotations

import gzip
import io
import re
import tarfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from rse_pf.config.resource_names import SERVICES_PREFIX
from rse_pf.errors import ConfigurationError, Conflict, NotFound, StoreError, UsageError
from rse_pf.object_store import ObjectStore, digest_of
from rse_pf.services.custom.dependencies import Dependencies, check_together
from rse_pf.services.custom.installed import InstalledService, dependencies_of
from rse_pf.services.custom.plain_files import check_plain, read_plain

__all__ = [
    "LIST_NAME",
    "LOOK_PERIOD_S",
    "MAX_ARCHIVE_BYTES",
    "SERVER_PLATFORM",
    "PublishedList",
    "PublishedService",
    "archive_name",
    "archive_of",
    "check_for_servers",
    "damaged",
    "decode_list",
    "publish",
    "read_list",
    "remove",
]

LIST_NAME = f"{SERVICES_PREFIX}/list.json"
"""Of the list in the artifact bucket; `archive_name` gives those of the archives."""
LOOK_PERIOD_S = 15
"""How often servers look at the list."""
SERVER_PLATFORM = "cp311-linux-x86_64"
"""What servers on AWS run: Debian 12 on x86-64."""
MAX_ARCHIVE_BYTES = 128 << 20
_NAME, _DIGEST = re.compile(r"[a-z][a-z0-9_-]{0,39}"), re.compile(r"[0-9a-f]{64}")
_MAX_TRIES = 8
_ELF_X86_64 = (b"\x7fELF\x02\x01", 62)
_MACHINE = slice(18, 20)
"""Of an ELF header: the machine it is for, little-endian."""
_SYMBOL_VERSION = re.compile(rb"\b(GLIBC|GLIBCXX)_(\d+)\.(\d+)(?:\.(\d+))?\b")
_NEWEST = {b"GLIBC": (2, 36, 0), b"GLIBCXX": (3, 4, 30)}
"""What Debian 12 has."""
_BUILD_HINT = "build it on Debian 12 (x86-64), for example in a container, and publish from there"


class PublishedService(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One service: the digest of its archive, and what is shown and compared without reading that.

    Attributes:
        archive: The sha256 of the archive in hex, which is part of its name.
        identity: The `InstalledService.identity`.
        packages: Names and versions of the Python packages of its own.
        published_s: Unix time.
    """

    name: str
    language: str
    archive: str
    size: int
    identity: str
    published_s: float
    packages: dict[str, str] = {}


class PublishedList(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The services that every server runs, sorted by name."""

    services: tuple[PublishedService, ...] = ()


def decode_list(data: bytes) -> PublishedList:
    """Return the list in *data*; raises ConfigurationError if it is none."""
    try:
        found = msgspec.json.decode(data, type=PublishedList)
    except msgspec.MsgspecError as error:
        raise damaged(f"{LIST_NAME} is no list of services: {error}") from error
    names = [each.name for each in found.services]
    digests = [each.archive for each in found.services]
    if names != sorted(set(names)) or not all(map(_NAME.fullmatch, names)):
        raise damaged(f"{LIST_NAME} names a service twice, or by a name that none has")
    if not all(map(_DIGEST.fullmatch, digests)):
        raise damaged(f"{LIST_NAME} names an archive without its digest")
    return found


def read_list(store: ObjectStore) -> PublishedList:
    """Return the list of *store*; an empty one if nothing was published."""
    return _read(store)[1]


def publish(service: InstalledService, root: Path, store: ObjectStore, *, now_s: float) -> PublishedService:
    """Store the archive of *service*, which is installed alone in *root*, and put it into the list.

    A service of the same name is replaced.

    Raises:
        ConfigurationError: Servers cannot run it, or another published service needs other versions.
        StoreError: Nothing was listed.
    """
    dependencies = check_for_servers(service, root)
    archive = archive_of(root)
    if len(archive) > MAX_ARCHIVE_BYTES:
        raise ConfigurationError(
            f"{service.name} is {len(archive)} bytes, above {MAX_ARCHIVE_BYTES}",
            hint="publish fewer files, or put models into the object store",
        )
    entry = PublishedService(
        name=service.name, language=service.language, archive=digest_of(archive), size=len(archive),
        identity=service.identity, published_s=now_s,
        packages={} if dependencies is None else dict(dependencies.packages),
    )  # fmt: skip
    _check_packages((entry, *read_list(store).services))
    store.put(archive_name(entry.archive), archive)
    _change(store, {entry.name: entry})
    return entry


def remove(name: str, store: ObjectStore) -> None:
    """Take a service out of the list; its archive stays until the bucket's rules delete it.

    Raises:
        UsageError: It is not in the list.
    """
    published = read_list(store)
    if name not in {each.name for each in published.services}:
        known = ", ".join(each.name for each in published.services) or "none"
        raise UsageError(f"no service {name!r} is published", hint=f"published are: {known}")
    _change(store, {name: None})


def check_for_servers(service: InstalledService, root: Path) -> Dependencies | None:
    """Return the packages of *service*, if any, after checking that servers on AWS can load it.

    Raises:
        ConfigurationError: Its packages or libraries are for another machine, or need a newer C library.
    """
    dependencies = dependencies_of(root / service.name)
    if dependencies is not None and dependencies.platform != SERVER_PLATFORM:
        raise ConfigurationError(
            f"the packages of {service.name} are for {dependencies.platform}, servers are {SERVER_PLATFORM}",
            hint="publish with Python 3.11 on Linux (x86-64)",
        )
    for path in _files(root):
        if re.search(r"\.so(\.\d+)*$", path.name):
            _check_library(service.name, path)
    return dependencies


def archive_of(root: Path) -> bytes:
    """Return all files below *root* as a compressed archive; equal files give equal bytes.

    Raises:
        UsageError: One of them is a link, or no file.
    """
    check_plain(root)
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as archive:
        for path in _files(root):
            content = read_plain(path)
            about = tarfile.TarInfo(path.relative_to(root).as_posix())
            about.size, about.mode = len(content), 0o644
            archive.addfile(about, io.BytesIO(content))
    return gzip.compress(packed.getvalue(), compresslevel=6, mtime=0)


def _read(store: ObjectStore) -> tuple[bytes | None, PublishedList]:
    try:
        data = store.get(LIST_NAME)
    except NotFound:
        return None, PublishedList()
    return data, decode_list(data)


def _change(store: ObjectStore, changes: Mapping[str, PublishedService | None]) -> None:
    """Replace the list by one with *changes*, whatever other operators publish meanwhile."""
    for _ in range(_MAX_TRIES):
        before, published = _read(store)
        merged = {**{each.name: each for each in published.services}, **changes}
        chosen = tuple(each for _, each in sorted(merged.items()) if each is not None)
        _check_packages(chosen)
        try:
            store.compare_and_swap(LIST_NAME, before, msgspec.json.encode(PublishedList(services=chosen)))
        except Conflict:
            continue
        return
    raise StoreError("the list of services changes all the time", hint="publish again")


def _check_packages(entries: Sequence[PublishedService]) -> None:
    """Raise ConfigurationError if two services need different versions of one package."""
    chosen: dict[str, PublishedService] = {}
    for each in entries:
        chosen.setdefault(each.name, each)
    check_together(
        {
            name: Dependencies(folder=Path(), digest="", packages=each.packages, platform=SERVER_PLATFORM)
            for name, each in chosen.items()
        }
    )


def _check_library(service: str, path: Path) -> None:
    data = path.read_bytes()
    magic, machine = _ELF_X86_64
    if not data.startswith(magic) or int.from_bytes(data[_MACHINE], "little") != machine:
        raise ConfigurationError(
            f"{path.name} of {service} is no library for x86-64, which the servers are", hint=_BUILD_HINT
        )
    for library, major, minor, patch in set(_SYMBOL_VERSION.findall(data)):
        wanted = (int(major), int(minor), int(patch or 0))
        if wanted > _NEWEST[library]:
            shown = ".".join(map(str, wanted if patch else wanted[:2]))
            raise ConfigurationError(
                f"{path.name} of {service} needs {library.decode()}_{shown}, Debian 12 has an older one",
                hint=_BUILD_HINT,
            )


def _files(root: Path) -> Iterator[Path]:
    for path in sorted(root.rglob("*")):
        if path.is_file() or path.is_symlink():
            yield path


def archive_name(digest: str) -> str:
    """Return the object name of the archive with this sha256 in hex."""
    return f"{SERVICES_PREFIX}/archives/{digest}"


def damaged(what: str) -> ConfigurationError:
    """Return the error that *what* was published is not what `publish` publishes."""
    return ConfigurationError(what, hint="publish the services again with: rse-pf service publish FOLDER")
