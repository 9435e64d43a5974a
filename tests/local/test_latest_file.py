"""A file that the disk refuses is written when there is space again, and nothing else stops meanwhile."""

from __future__ import annotations

import asyncio
import errno
from collections.abc import Callable
from pathlib import Path

import pytest

from rse_pf import files
from rse_pf.local import latest_file
from rse_pf.local.latest_file import LatestFile

SOON_S = 10.0


class Disk:
    """Refuses writes while it is full, and counts all attempts."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.is_full = False
        self.attempts = 0
        monkeypatch.setattr(latest_file, "replace_file", self._replace)

    def _replace(self, path: Path, text: str) -> None:
        self.attempts += 1
        if self.is_full:
            raise OSError(errno.ENOSPC, "No space left on device")
        files.replace_file(path, text)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


async def until(found: Callable[[], bool]) -> None:
    async def wait() -> None:
        while not found():
            await asyncio.sleep(0)

    await asyncio.wait_for(wait(), SOON_S)


async def test_the_newest_content_is_written_once_the_disk_has_space(tmp_path: Path, disk: Disk) -> None:
    problems: list[str] = []
    path = tmp_path / "platform.json"

    file = LatestFile(path, on_problem=problems.append, retry_s=0.001)
    file.write("one")
    disk.is_full = True
    file.write("two")
    file.write("three")
    await until(lambda: disk.attempts > 5)
    assert path.read_text() == "one"
    disk.is_full = False
    await until(lambda: path.read_text() == "three")
    assert problems == ["platform.json cannot be written yet: No space left on device"]


async def test_each_time_without_space_is_told_once(tmp_path: Path, disk: Disk) -> None:
    problems: list[str] = []

    file = LatestFile(tmp_path / "x", on_problem=problems.append, retry_s=60.0)
    for text in ("one", "two"):
        disk.is_full = False
        file.write(text)
        disk.is_full = True
        file.write(f"{text} lost")
    file.close()
    assert len(problems) == 2


def test_a_file_that_was_never_written_fails_at_once(tmp_path: Path, disk: Disk) -> None:
    disk.is_full = True

    with pytest.raises(OSError, match="No space left"):
        LatestFile(tmp_path / "x").write("one")


async def test_nothing_is_written_after_the_end(tmp_path: Path, disk: Disk) -> None:
    file = LatestFile(tmp_path / "x", retry_s=0.0)
    file.write("one")
    disk.is_full = True
    file.write("two")
    file.close()
    disk.is_full = False
    attempts = disk.attempts
    for _ in range(100):
        await asyncio.sleep(0)  # a retry would be due in each round of the loop
    assert disk.attempts == attempts
    assert (tmp_path / "x").read_text() == "one"
