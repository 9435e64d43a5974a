"""A deny list changes on a small disk that is really full, while another program takes what gets free."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from rse_pf.auth.roster import EnrolledRobot, Roster
from rse_pf.auth.trust_store import ROBOTS_NAME, AccessControlStore
from rse_pf.errors import StoreFull
from rse_pf.local.disk_watch import DiskWatch, access_control_store
from rse_pf.storage.disk_reserve import RESERVE_BYTES, DiskReserve
from rse_pf.storage.object_store import DirectoryStore

Disk = Callable[[str], Path]
Fill = Callable[[Path], Path]


def access_on(disk: Path) -> tuple[AccessControlStore, DiskReserve]:
    reserve = DiskReserve(disk / "disk-reserve")
    access = AccessControlStore(DirectoryStore(disk, reserve))
    access.create_missing()
    return access, reserve


def disable(access: AccessControlStore, name: str) -> None:
    access.change_deny_list(lambda denied: denied.with_robot("t", name, 1.0))


def test_a_deny_list_can_be_changed_while_others_take_every_free_block(small_disk: Disk, fill: Fill):
    disk = small_disk("8m")
    access, reserve = access_on(disk)
    reserve.fill()

    for number in range(60):
        fill(disk)
        disable(access, f"r-{number}")

    assert len(access_on(disk)[0].deny_list().disabled) == 60


def test_without_a_reserve_the_list_stays_as_it_was(small_disk: Disk, fill: Fill):
    disk = small_disk("8m")
    access, _ = access_on(disk)
    disable(access, "before")
    fill(disk)

    with pytest.raises(StoreFull, match="no space left"):
        disable(access, "after")

    assert [each.robot for each in access.deny_list().disabled] == ["before"]


def test_a_large_roster_can_be_changed_once_and_the_deny_list_still_after_a_change_that_failed(
    small_disk: Disk, fill: Fill
):
    disk = small_disk("40m")
    watch = DiskWatch(disk, "memory:", emit=lambda event, **details: None)
    watch.prepare()
    access = access_control_store(disk)
    scopes = tuple(f"services:{letter * 60}" for letter in "abcdefghijklmnop")
    robots = [
        EnrolledRobot(robot=f"r-{number}", x=f"{number:A>43}", scopes=scopes) for number in range(5_000)
    ]
    access.change_roster(lambda roster: Roster(robots=tuple(robots)))
    assert (disk / ROBOTS_NAME).stat().st_size > RESERVE_BYTES
    watch.prepare()

    fill(disk)
    access.change_roster(lambda roster: roster.enrolled(EnrolledRobot(robot="one", x="B" * 43)))
    fill(disk)
    with pytest.raises(StoreFull):
        access.change_roster(lambda roster: roster.enrolled(EnrolledRobot(robot="two", x="C" * 43)))
    fill(disk)
    disable(access, "one")

    assert access.roster().find("default", "one") is not None
    assert access.deny_list().is_disabled("t", "one")


def test_a_reserve_is_made_whole_again_when_there_is_space(small_disk: Disk, fill: Fill):
    disk = small_disk("8m")
    access, reserve = access_on(disk)
    reserve.fill()
    hog = fill(disk)
    disable(access, "r")
    fill(disk)
    with pytest.raises(OSError, match="No space left"):
        reserve.fill()
    hog.unlink()

    reserve.fill()

    status = os.stat(disk / "disk-reserve")
    assert (status.st_size, status.st_blocks * 512) == (RESERVE_BYTES, RESERVE_BYTES)
