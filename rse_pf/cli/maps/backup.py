"""Back up the maps of a tenant in a file and restore them: ``rse-pf map backup`` and ``map restore``.

Both work on the object store itself, so the platform may run or be stopped.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from rse_pf.aws.storage import open_data_store
from rse_pf.command_line.map_store import StoreRequest, open_maps
from rse_pf.command_line.options import option
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.maps.backup import BackupContent, CheckedBackup, check_backup, restore_backup, write_backup
from rse_pf.storage.files import OWNER_ONLY, TEMPORARY_PREFIX, check_exists, sync_folder
from rse_pf.storage.quotas import TenantAccount
from rse_pf.terminal import at_work, counted, show, show_json

__all__ = ["BackupRequest", "RestoreRequest", "run_backup", "run_restore"]


@dataclass(frozen=True, kw_only=True)
class BackupRequest(StoreRequest):
    """The options of rse-pf map backup: a tenant, a store, and the file that is written."""

    file: Path = option(metavar="FILE", help="the backup; an earlier one is replaced")


@dataclass(frozen=True, kw_only=True)
class RestoreRequest(StoreRequest):
    """The options of rse-pf map restore: a tenant, a store, and the backup that is read."""

    file: Path = option(metavar="FILE", help="the backup, which rse-pf map backup wrote")
    overwrite: bool = option(
        "--overwrite",
        help="set the heads of maps that exist to those of the backup; their other versions stay",
    )


def run_backup(request: BackupRequest, settings: PlatformSettings) -> None:
    """Write all maps of the tenant to the file, which is replaced in one step, and print what was written."""
    settings = request.settings_with_store(settings)
    maps = open_maps(settings, request.tenant)
    if not maps.names():
        raise UsageError(
            f"tenant {request.tenant!r} has no maps", hint="rse-pf tenant list shows the tenants"
        )
    with _replacing(request.file) as file, at_work("writing the backup"):
        store = open_data_store(settings)
        content = write_backup(file, maps, store, tenant=request.tenant, created_s=time.time())
    size, backed_up = request.file.stat().st_size, counted(len(content.heads), "map")
    of = f"of tenant {request.tenant!r} in {settings.data.store}"
    _print(request, content, f"{backed_up} {of} backed up in {request.file}: {size} bytes")


def run_restore(request: RestoreRequest, settings: PlatformSettings) -> None:
    """Check the whole backup, write the versions that the store lacks, and print how many these were."""
    settings = request.settings_with_store(settings)
    check_exists(request.file, "name a file that rse-pf map backup wrote")
    with request.file.open("rb") as file, at_work("restoring the backup"):
        backup = check_backup(file)
        written = _restore(request, settings, backup)
    restored, versions = counted(len(backup.content.heads), "map"), counted(written, "version")
    _print(
        request,
        backup.content,
        f"{restored} of tenant {request.tenant!r} restored in {settings.data.store}: {versions} written, "
        "all others were there",
    )


def _restore(request: RestoreRequest, settings: PlatformSettings, backup: CheckedBackup) -> int:
    """Restore *backup*, and return the number of versions that were written.

    Raises:
        UsageError: It is a backup of another tenant.
        QuotaExceeded: The versions would exceed the tenant's quota; nothing is written then.
    """
    content = backup.content
    if content.tenant != request.tenant:
        raise UsageError(
            f"this is a backup of tenant {content.tenant!r}, and not of {request.tenant!r}",
            hint=f"restore it with --tenant {content.tenant}",
        )
    store = open_data_store(settings)
    account = TenantAccount(store, request.tenant, settings.data)
    maps = open_maps(settings, request.tenant)
    return restore_backup(
        backup, maps, store, is_overwriting=request.overwrite, charge=account.reserve,
        check_room=lambda size: account.reserve(0, margin=size),
    )  # fmt: skip


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[BinaryIO]:
    """Yield a new file that replaces *path* in one step after the block, and is on the disk then.

    If the block raises an error, *path* stays as it was.

    Raises:
        UsageError: No file can be created in the folder of *path*.
    """
    folder = path.absolute().parent
    temporary = folder / f"{TEMPORARY_PREFIX}{secrets.token_hex(8)}"
    try:
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, OWNER_ONLY)
    except OSError as error:
        raise UsageError(f"cannot write {path}: {error.strerror}", hint="name another file") from error
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
            file.flush()
            os.fsync(handle)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(folder)


def _print(request: StoreRequest, content: BackupContent, line: str) -> None:
    if request.json:
        show_json(
            {"tenant": content.tenant, "created_s": content.created_s, "heads": content.heads}, indent=2
        )
    else:
        show(line)
