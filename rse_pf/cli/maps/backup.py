"""Back up the maps of a tenant in a file and restore them: ``rse-pf map backup`` and ``map restore``.

Works on the store, while the platform runs or while it is stopped.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import secrets
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from rse_pf.aws.storage import open_data_store
from rse_pf.command_line.map_store import open_maps
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.maps.backup import BackupContent, CheckedBackup, check_backup, restore_backup, write_backup
from rse_pf.storage.files import OWNER_ONLY, TEMPORARY_PREFIX, check_exists, sync_folder
from rse_pf.storage.quotas import TenantAccount
from rse_pf.terminal import at_work, counted, show, show_json

__all__ = ["add_backup_arguments", "add_restore_arguments", "run_backup", "run_restore"]


def add_backup_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``map backup``."""
    parser.add_argument("file", type=Path, metavar="FILE", help="the backup; an earlier one is replaced")


def add_restore_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``map restore``."""
    parser.add_argument("file", type=Path, metavar="FILE", help="what rse-pf map backup wrote")
    parser.add_argument(
        "--overwrite", action="store_true",
        help="set the heads of maps that exist to those of the backup; their other versions stay",
    )  # fmt: skip


def run_backup(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Write the file; the exit code is 0."""
    maps = open_maps(settings, args.tenant)
    if not maps.names():
        raise UsageError(f"tenant {args.tenant!r} has no maps", hint="rse-pf tenant list shows the tenants")
    with _replacing(args.file) as file, at_work("writing the backup"):
        store = open_data_store(settings)
        content = write_backup(file, maps, store, tenant=args.tenant, created_s=time.time())
    size, backed_up = args.file.stat().st_size, counted(len(content.heads), "map")
    of = f"of tenant {args.tenant!r} in {settings.data.store}"
    _print(args, content, f"{backed_up} {of} backed up in {args.file}: {size} bytes")
    return 0


def run_restore(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Check the file, and restore it; the exit code is 0."""
    check_exists(args.file, "name a file that rse-pf map backup wrote")
    with args.file.open("rb") as file, at_work("restoring the backup"):
        backup = check_backup(file)
        written = _restore(args, settings, backup)
    restored, versions = counted(len(backup.content.heads), "map"), counted(written, "version")
    _print(
        args,
        backup.content,
        f"{restored} of tenant {args.tenant!r} restored in {settings.data.store}: {versions} written, "
        "all others were there",
    )
    return 0


def _restore(args: argparse.Namespace, settings: PlatformSettings, backup: CheckedBackup) -> int:
    content = backup.content
    if content.tenant != args.tenant:
        raise UsageError(
            f"this is a backup of tenant {content.tenant!r}, and not of {args.tenant!r}",
            hint=f"--tenant {content.tenant}",
        )
    store = open_data_store(settings)
    account = TenantAccount(store, args.tenant, settings.data)
    maps = open_maps(settings, args.tenant)
    return restore_backup(
        backup, maps, store, is_overwriting=args.overwrite, charge=account.reserve,
        check_room=lambda size: account.reserve(0, margin=size),
    )  # fmt: skip


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[BinaryIO]:
    """Yield a new file that replaces *path* in one step, durably, unless the caller raises an error."""
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


def _print(args: argparse.Namespace, content: BackupContent, line: str) -> None:
    if args.json:
        show_json(
            {"tenant": content.tenant, "created_s": content.created_s, "heads": content.heads}, indent=2
        )
    else:
        show(line)
