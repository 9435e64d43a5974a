"""Files of state: whole or not at all, private or refused."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from rse_pf.errors import UsageError
from rse_pf.storage.files import (
    OWNER_ONLY,
    create_private_file,
    read_private_file,
    replace_file,
    replace_json,
)


def mode_of(path: Path) -> int:
    """Return the permissions of *path*."""
    return path.stat().st_mode & 0o777


@pytest.mark.parametrize("data", [b"new", "new"])
@pytest.mark.parametrize("is_durable", [False, True])
def test_a_file_is_replaced_and_no_temporary_file_stays(
    tmp_path: Path, data: bytes | str, is_durable: bool
) -> None:
    (tmp_path / "state").write_text("old")

    replace_file(tmp_path / "state", data, is_durable=is_durable)

    assert (tmp_path / "state").read_text() == "new"
    assert os.listdir(tmp_path) == ["state"]


def test_a_failed_replacement_leaves_the_old_file_and_no_temporary_file(tmp_path: Path) -> None:
    (tmp_path / "folder" / "inside").mkdir(parents=True)

    with pytest.raises(OSError):
        replace_file(tmp_path / "folder", b"new")

    assert os.listdir(tmp_path) == ["folder"]


def test_a_private_file_that_others_could_read_is_private_once_replaced(tmp_path: Path) -> None:
    (tmp_path / "key").write_text("old")
    (tmp_path / "key").chmod(0o644)

    replace_file(tmp_path / "key", "new", mode=OWNER_ONLY)

    assert mode_of(tmp_path / "key") == 0o600


def test_the_umask_decides_who_may_read_a_file_that_holds_no_secret(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        replace_json(tmp_path / "state", {"a": 1})
    finally:
        os.umask(before)

    assert mode_of(tmp_path / "state") == 0o640
    assert json.loads((tmp_path / "state").read_text()) == {"a": 1}


def test_a_private_file_is_created_once_and_follows_no_link(tmp_path: Path) -> None:
    create_private_file(tmp_path / "key", "secret")
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")

    for taken in ("key", "link"):
        with pytest.raises(FileExistsError):
            create_private_file(tmp_path / taken, "other")

    assert mode_of(tmp_path / "key") == 0o600
    assert read_private_file(tmp_path / "key", "the key", hint="make one") == b"secret"
    assert not (tmp_path / "elsewhere").exists()


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620])
def test_a_secret_that_others_may_read_or_write_is_refused(tmp_path: Path, mode: int) -> None:
    create_private_file(tmp_path / "key", "secret")
    (tmp_path / "key").chmod(mode)

    with pytest.raises(UsageError, match="others may read the key") as told:
        read_private_file(tmp_path / "key", "the key", hint="make one")

    assert told.value.hint == f"chmod 600 {tmp_path / 'key'}"
