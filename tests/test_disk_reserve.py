"""Spare files and preallocated blocks, on a small disk that is really full."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from rse_pf.auth.roster import DenyList
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.disk_reserve import SpareFiles, allocated_bytes, preallocate
from rse_pf.object_store import DirectoryStore

Disk = Callable[[str], Path]
Fill = Callable[[Path], Path]


def test_a_deny_list_can_be_changed_on_a_full_disk_as_often_as_an_operator_likes(
    small_disk: Disk, fill: Fill
):
    disk = small_disk("4m")
    spares = SpareFiles(disk / "reserve")
    access = AccessControlStore(DirectoryStore(disk, spares))
    access.create_missing()
    spares.refill()
    fill(disk)

    for number in range(60):
        access.change_deny_list(lambda denied, name=f"r-{number}": denied.with_robot("t", name, 1.0))
    access.change_deny_list(lambda denied: DenyList())
    access.change_deny_list(lambda denied: denied.with_robot("t", "last", 1.0))

    again = AccessControlStore(DirectoryStore(disk))
    assert [each.robot for each in again.deny_list().disabled] == ["last"]


def test_without_spare_files_a_robot_can_be_disabled_in_the_blocks_of_the_list(small_disk: Disk, fill: Fill):
    disk = small_disk("4m")
    access = AccessControlStore(DirectoryStore(disk, SpareFiles(disk / "reserve")))
    access.create_missing()
    fill(disk)

    for number in range(10):
        access.change_deny_list(lambda denied, name=f"r-{number}": denied.with_robot("t", name, 1.0))
    access.change_deny_list(lambda denied: DenyList())
    access.change_deny_list(lambda denied: denied.with_robot("t", "last", 1.0))

    assert [each.robot for each in access.deny_list().disabled] == ["last"]


def test_a_text_that_is_too_long_for_the_reserve_changes_nothing(small_disk: Disk, fill: Fill):
    disk = small_disk("4m")
    path = disk / "list.json"
    path.write_text("[]")
    spares = SpareFiles(disk / "reserve")
    spares.refill(8192)
    fill(disk)

    with pytest.raises(OSError, match="none in the reserve") as caught:
        spares.replace(path, b" " * 8193)

    assert caught.value.errno == errno.ENOSPC
    assert path.read_text() == "[]"


def test_spares_are_made_anew_when_there_is_space_again(small_disk: Disk, fill: Fill):
    disk = small_disk("4m")
    path = disk / "list.json"
    path.write_text("[]")
    spares = SpareFiles(disk / "reserve")
    spares.refill()
    hog = fill(disk)
    spares.replace(path, b"[1]")
    with pytest.raises(OSError, match="No space left"):
        spares.refill()
    hog.unlink()

    spares.refill()

    assert json.loads(path.read_text()) == [1]
    assert all(each.stat().st_blocks * 512 >= 256 << 10 for each in (disk / "reserve").iterdir())


def test_preallocated_blocks_are_not_given_back_by_an_attempt_that_fails(small_disk: Disk, fill: Fill):
    disk = small_disk("4m")
    with (disk / "log").open("ab", buffering=0) as log:
        preallocate(log.fileno(), 64 << 10)
        fill(disk)
        with pytest.raises(OSError, match="No space left"):
            preallocate(log.fileno(), 128 << 10)

        assert allocated_bytes(log.fileno()) == 64 << 10
        assert log.write(bytes(64 << 10)) == 64 << 10
        assert os.fstat(log.fileno()).st_size == 64 << 10
