"""When a disk counts as nearly full, and what an operator is told."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from pathlib import Path

from rse_pf.local.disk_watch import DiskWatch, disk_level

MIB = 1 << 20


def test_each_change_is_one_event_that_names_folder_and_bytes(
    small_disk: Callable[[str], Path], fill: Callable[[Path], Path]
):
    disk = small_disk("8m")
    told: list[dict[str, object]] = []
    back: list[bool] = []
    watch = DiskWatch(
        disk,
        "memory:",
        emit=lambda event, **more: told.append({"event": event, **more}),
    )
    watch.on_space = lambda: back.append(watch.is_full())
    watch.is_full()
    hog = fill(disk)
    assert watch.is_full()
    assert watch.is_full()
    hog.unlink()
    assert not watch.is_full()

    assert [event["event"] for event in told] == ["disk-full", "disk-ok"]
    assert told[0]["free_bytes"] == 0
    assert f"0 of 8 MiB are free on the disk of {disk}" in str(told[0]["reason"])
    assert back == [False]


async def test_the_newest_text_of_a_file_is_written_once_there_is_space(
    small_disk: Callable[[str], Path], fill: Callable[[Path], Path]
):
    disk = small_disk("8m")
    path = disk / "targets.json"
    told: list[str] = []
    watch = DiskWatch(disk, "memory:", emit=lambda event, **more: told.append(event))
    watch.write(path, "one")
    hog = fill(disk)
    watch.write(path, "two")
    watch.write(path, "three")
    assert (path.read_text(), told) == ("one", ["not-written"])
    hog.unlink()

    watching = asyncio.ensure_future(watch.watch())
    ends_s = time.monotonic() + 30.0
    while path.read_text() != "three":
        assert time.monotonic() < ends_s
        await asyncio.sleep(0.01)
    watching.cancel()


def test_a_disk_is_low_below_a_tenth_and_full_below_a_mebibyte():
    assert [disk_level(free, 1000 * MIB) for free in (200 * MIB, 99 * MIB, MIB - 1)] == ["ok", "low", "full"]


def test_a_disk_at_the_threshold_does_not_change_its_level_with_every_write():
    assert disk_level(105 * MIB, 1000 * MIB, "low") == "low"
    assert disk_level(111 * MIB, 1000 * MIB, "low") == "ok"
    assert disk_level(MIB + 1, 1000 * MIB, "full") == "full"
