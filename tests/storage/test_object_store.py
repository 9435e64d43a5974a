"""One contract for every object store, and what a crash leaves behind."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO

import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from rse_pf.aws.clients import make_client
from rse_pf.aws.storage import open_bucket
from rse_pf.errors import Conflict, NotFound, StoreError, StoreFull, UsageError
from rse_pf.storage.object_store import (
    DirectoryStore,
    MemoryStore,
    ObjectInfo,
    ObjectStore,
    Usage,
    _is_no_folder,
    digest_of,
    open_store,
)
from tests.kit.emulated_aws import REGION, emulated_aws

STORES: dict[str, Callable[[Path], ObjectStore]] = {
    "directory": lambda folder: DirectoryStore(folder / "objects"),
    "memory": lambda folder: MemoryStore(),
}
"""Every other store is added here; S3 comes with its emulator, in the fixture."""


@pytest.fixture(params=[*STORES, "s3"])
def store(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[ObjectStore]:
    """Each kind of store, empty."""
    if request.param in STORES:
        yield STORES[request.param](tmp_path)
        return
    with emulated_aws(monkeypatch, request.node.nodeid):
        bucket = open_bucket("objects", REGION)
        make_client("s3", REGION).create_bucket(
            Bucket="objects", CreateBucketConfiguration={"LocationConstraint": REGION}
        )
        yield bucket


def names(store: ObjectStore, prefix: str = "") -> list[str]:
    return [info.name for info in store.list(prefix)]


def test_a_stored_object_is_complete(store: ObjectStore) -> None:
    data = bytes(range(256)) * 1000

    store.put("maps/lab/cloud.bin", data)

    assert store.get("maps/lab/cloud.bin") == data
    assert store.head("maps/lab/cloud.bin") == ObjectInfo(name="maps/lab/cloud.bin", size=len(data))


def test_a_piece_is_read_where_it_lies_and_ends_where_the_object_does(store: ObjectStore) -> None:
    store.put("a", b"0123456789")

    pieces = [store.get_range("a", start, length) for start, length in [(0, 4), (8, 4), (10, 4), (3, 0)]]

    assert pieces == [b"0123", b"89", b"", b""]
    with pytest.raises(NotFound):
        store.get_range("b", 0, 1)


def test_names_are_listed_in_order_and_by_prefix(store: ObjectStore) -> None:
    for name in ("b", "a/2", "a/10", "a-1", "ab/c"):
        store.put(name, name.encode())

    assert names(store) == sorted(["b", "a/2", "a/10", "a-1", "ab/c"])
    assert names(store, "a/") == ["a/10", "a/2"]
    assert names(store, "a") == ["a-1", "a/10", "a/2", "ab/c"]
    assert names(store, "c") == []
    assert names(store, "a/22") == []
    assert [info.size for info in store.list("a/")] == [4, 3]


def test_a_list_continues_after_a_name(store: ObjectStore) -> None:
    digests = [digest_of(bytes([n])) for n in range(40)]
    stored = [*sorted(f"objects/lab/robot-1/{each}" for each in digests), "objects/lab/robot-10/x", "z/a"]
    for name in stored:
        store.put(name, b"x")

    for row, name in enumerate(stored):
        assert [info.name for info in store.list(after=name)] == stored[row + 1 :]
    page = [info.name for info in store.list("objects/lab/robot-1/", after=stored[9])]
    assert page == stored[10:40]
    assert [info.name for info in store.list("objects/lab/robot-1/", after="z")] == []
    assert [info.name for info in store.list("objects/lab/robot-1/", after="a")] == stored[:40]


def test_folders_are_what_stands_before_the_next_slash(store: ObjectStore) -> None:
    for name in ("maps/lab/b/head", "maps/lab/a/head", "maps/lab/a/versions/1", "maps/lab/file", "maps/x/y"):
        store.put(name, b"x")

    assert list(store.folders("maps/lab/")) == ["a", "b"]
    assert list(store.folders("maps/")) == ["lab", "x"]
    assert list(store.folders("nothing/")) == []


def test_an_object_of_many_pieces_is_complete(store: ObjectStore) -> None:
    pieces = [bytes([n]) * (6 << 20) for n in range(3)]

    store.put_pieces("large", iter(pieces))
    store.put_pieces("empty", iter(()))

    assert store.get("large") == b"".join(pieces)
    assert store.get("empty") == b""


@pytest.mark.parametrize("count", [1, 3])
def test_an_object_whose_pieces_fail_is_not_stored(store: ObjectStore, count: int) -> None:
    def pieces() -> Iterator[bytes]:
        yield from [bytes(6 << 20)] * count
        raise StoreError("the last part is missing")

    with pytest.raises(StoreError, match="last part"):
        store.put_pieces("large", pieces())

    assert names(store) == []


def test_an_object_counts_for_four_kib_at_least(store: ObjectStore) -> None:
    assert store.usage("objects/lab/robot-1/") == Usage()
    for size in (0, 8, 4096, 10_000):
        name = f"objects/lab/robot-1/{digest_of(bytes(size))}"
        store.put(name, bytes(size))
        store.put(name, bytes(size))
    store.put(f"objects/lab/robot-2/{digest_of(b'x')}", b"x")

    assert store.usage("objects/lab/robot-1/") == Usage(4, 3 * 4096 + 10_000)
    assert store.usage("objects/lab/") == Usage(5, 4 * 4096 + 10_000)
    store.delete(name)
    assert store.usage("objects/lab/robot-1/") == Usage(3, 3 * 4096)


def test_a_swap_requires_the_expected_content(store: ObjectStore) -> None:
    store.compare_and_swap("head", None, b"1")
    store.compare_and_swap("head", b"1", b"2")

    for expected in (None, b"1", b""):
        with pytest.raises(Conflict):
            store.compare_and_swap("head", expected, b"3")
    with pytest.raises(Conflict):
        store.compare_and_swap("other", b"1", b"3")
    assert store.get("head") == b"2"
    assert names(store) == ["head"]


HOSTILE = [
    "", ".", "..", "/", "/etc/passwd", "../x", "a/../../x", "a//b", "a/", "./a", ".hidden", "a/.hidden",
    "a\0b", "a\n", "a b", "a\\b", "C:\\x", "%2e%2e/x", "~root", "ünïcode", "\u202eexe", "x" * 129,
    "/".join("a" * 11), "-rf", "a/-rf", "\ud800",
]  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_name_is_refused_by_every_method(store: ObjectStore, name: str) -> None:
    for call in (
        lambda: store.get(name),
        lambda: store.head(name),
        lambda: store.put(name, b"x"),
        lambda: store.delete(name),
        lambda: store.compare_and_swap(name, None, b"x"),
    ):
        with pytest.raises(StoreError, match="is not a name") as caught:
            call()
        assert type(caught.value) is StoreError
    assert names(store) == []


@given(st.text(max_size=40))
@hypothesis_settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_name_leads_out_of_the_folder(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "store"
    with contextlib.suppress(StoreError):
        DirectoryStore(folder).put(name, b"x")
    assert {path.name for path in tmp_path.iterdir()} <= {"store"}


def test_a_link_in_the_folder_is_no_object(tmp_path: Path) -> None:
    (tmp_path / "secret").write_bytes(b"secret")
    store = DirectoryStore(tmp_path / "objects")
    store.put("real", b"x")
    (tmp_path / "objects" / "link").symlink_to(tmp_path / "secret")

    with pytest.raises(NotFound):
        store.get("link")
    with pytest.raises(NotFound):
        store.head("link")
    assert names(store) == ["real"]


def test_an_object_cannot_be_a_folder_too(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path)
    store.put("a", b"x")

    with pytest.raises(StoreError) as caught:
        store.put("a/b", b"y")

    assert not isinstance(caught.value, NotFound)
    assert store.get("a") == b"x"


def test_a_page_reads_only_the_folders_that_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, prefix = DirectoryStore(tmp_path), "objects/default/robot-1/"
    for number in range(1000):
        path = tmp_path / f"{prefix}+{number % 256:02x}" / f"{number % 256:02x}{number:062x}"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    read: list[str] = []
    scandir = os.scandir
    monkeypatch.setattr(os, "scandir", lambda path: read.append(str(path)) or scandir(path))

    page = list(itertools.islice(store.list(prefix, after=f"{prefix}80"), 20))

    assert page[0].name == f"{prefix}80{128:062x}"
    assert len(read) == 1 + 5  # the robot's folder, and 20 objects in folders of 4


def test_usage_reads_only_folders_that_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, prefix = DirectoryStore(tmp_path), "objects/default/robot-1/"
    for number in range(20):
        store.put(prefix + digest_of(bytes([number])), b"x")
    for folder in [tmp_path / prefix, *(tmp_path / prefix).iterdir()]:
        os.utime(folder, (1, 1))
    assert store.usage(prefix).objects == 20
    read: list[str] = []
    scandir = os.scandir
    monkeypatch.setattr(os, "scandir", lambda path: read.append(str(path)) or scandir(path))
    other = DirectoryStore(tmp_path)

    assert store.usage(prefix).objects == 20
    assert read == []
    other.delete(prefix + digest_of(bytes([3])))
    assert store.usage(prefix).objects == 19
    assert len(read) == 1


def test_nothing_is_left_of_what_was_deleted(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path / "store")
    store.put("uploads/lab/robot-1/abc/size", b"8")
    store.put("uploads/lab/robot-1/abc/part-0", b"x")
    store.compare_and_swap("jobs/lab/robot-1/key", None, b"1")

    for name in names(store):
        store.delete(name)

    left = {path.relative_to(tmp_path / "store").as_posix() for path in tmp_path.glob("store/**/*")}
    assert left == {"uploads", "uploads/lab", "uploads/lab/robot-1", "jobs", "jobs/lab"}


def is_waited_for(lock: BinaryIO) -> bool:
    """Return whether somebody waits for the lock on this file."""
    inode = f":{os.fstat(lock.fileno()).st_ino} "
    return any("->" in line and inode in line for line in Path("/proc/locks").read_text().splitlines())


def locked(path: Path) -> BinaryIO:
    lock = path.open("wb")
    fcntl.flock(lock, fcntl.LOCK_EX)
    return lock


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def test_a_writer_that_waited_for_a_removed_lock_waits_for_the_new_one(tmp_path: Path) -> None:
    store, path = DirectoryStore(tmp_path), tmp_path / ".lock-head"
    store.put("head", b"1")
    with ThreadPoolExecutor(1) as pool, locked(path) as first:
        writer = pool.submit(store.compare_and_swap, "head", b"1", b"2")
        until(lambda: is_waited_for(first))
        path.unlink()  # as one does who removes the object
        with locked(path) as second:
            first.close()
            until(lambda: is_waited_for(second) or writer.done())
            assert not writer.done(), "two writers hold the lock"
            store.put("head", b"3")
        with pytest.raises(Conflict):
            writer.result(30)
    assert store.get("head") == b"3"


def test_writers_and_removers_of_one_folder_never_disturb_each_other(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path)

    def work(number: int) -> None:
        for turn in range(100):
            store.put(f"uploads/a/{number}", b"x")
            with contextlib.suppress(Conflict):
                store.compare_and_swap("uploads/a/head", None, b"%d" % turn)
            store.delete(f"uploads/a/{number}")
            store.delete("uploads/a/head")

    with ThreadPoolExecutor(4) as pool:
        for each in [pool.submit(work, number) for number in range(4)]:
            each.result(60)
    assert names(store) == []


@pytest.mark.parametrize("error", [FileExistsError, FileNotFoundError])
def test_a_folder_that_a_remover_takes_while_it_is_made_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[OSError]
) -> None:
    store, mkdir, made = DirectoryStore(tmp_path), os.mkdir, []

    def first_taken(path: str) -> None:
        made.append(path)
        if len(made) == 1:  # another writer made it, and a remover took it, or its parent, at once
            raise error(path)
        mkdir(path)

    monkeypatch.setattr(os, "mkdir", first_taken)
    store.put("uploads/a/1", b"x")

    assert len(made) > 1
    assert names(store) == ["uploads/a/1"]


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_reported_and_leaves_the_old_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    store = DirectoryStore(tmp_path)
    store.put("a", b"old")

    def full(handle: int) -> None:
        raise OSError(code, "no space")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StoreFull):
        store.put("a", b"new")

    assert store.get("a") == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def put_by_parts(store: DirectoryStore, name: str) -> None:
    store.append("uploads/u1", 0, b"first ")
    store.append("uploads/u1", 6, b"second")
    store.adopt(name, "uploads/u1", 12)


@pytest.mark.parametrize(
    "write",
    [
        lambda store, name: store.put(name, b"data"),
        lambda store, name: store.put_pieces(name, iter([b"da", b"ta"])),
        lambda store, name: store.compare_and_swap(name, None, b"data"),
        put_by_parts,
    ],
    ids=["put", "put_pieces", "compare_and_swap", "append and adopt"],
)
def test_what_is_stored_is_synced_before_it_has_its_name_and_the_name_before_the_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[[DirectoryStore, str], None]
) -> None:
    fsync, replace, rename = os.fsync, os.replace, os.rename
    steps: list[tuple[str, int]] = []  # what happened, to which inode

    def note_sync(handle: int) -> None:
        fsync(handle)
        steps.append(("synced", os.fstat(handle).st_ino))

    def note_name(move: Callable[[str, str], None]) -> Callable[[str, str], None]:
        def named(source: str, target: str) -> None:
            move(source, target)
            steps.append(("named", os.stat(target).st_ino))

        return named

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(os, "replace", note_name(replace))
    monkeypatch.setattr(os, "rename", note_name(rename))
    write(DirectoryStore(tmp_path), "maps/kitchen/head")

    path = tmp_path / "maps" / "kitchen" / "head"
    own, named = path.stat().st_ino, steps.index(("named", path.stat().st_ino))
    assert ("synced", own) in steps[:named], "it has its name before its bytes are on the disk"
    for folder in (path.parent, path.parent.parent, tmp_path):
        assert ("synced", folder.stat().st_ino) in steps[named + 1 :], f"{folder.name} is not on the disk"


CRASH = """
import os, signal, sys
from pathlib import Path
from rse_pf.storage.object_store import DirectoryStore
store = DirectoryStore(Path(sys.argv[1]))
store.put("a", b"old")
die = lambda *args: os.kill(os.getpid(), signal.SIGKILL)
setattr(os, sys.argv[2], die)
store.put("a", b"new" * 100000)
"""


@pytest.mark.system
@pytest.mark.parametrize("moment", ["fsync", "replace"])
def test_a_crash_in_the_middle_of_a_write_leaves_the_old_version(tmp_path: Path, moment: str) -> None:
    ended = subprocess.run([sys.executable, "-c", CRASH, str(tmp_path), moment], timeout=60, check=False)

    store = DirectoryStore(tmp_path)
    assert ended.returncode == -signal.SIGKILL
    assert store.get("a") == b"old"
    assert names(store) == ["a"], "a half-written object is visible"


RACE = """
import sys
from pathlib import Path
from rse_pf.aws.storage import open_bucket
from rse_pf.aws.clients import make_client
from rse_pf.errors import Conflict
from rse_pf.storage.object_store import DirectoryStore
store = DirectoryStore(Path(sys.argv[1]))
won = 0
while won < 50:
    before = store.get("counter")
    try:
        store.compare_and_swap("counter", before, b"%d" % (int(before) + 1))
    except Conflict:
        continue
    won += 1
"""


@pytest.mark.system
def test_no_swap_is_lost_between_processes(tmp_path: Path) -> None:
    store = DirectoryStore(tmp_path)
    store.put("counter", b"0")

    racers = [subprocess.Popen([sys.executable, "-c", RACE, str(tmp_path)]) for _ in range(3)]
    ended = [racer.wait(timeout=60) for racer in racers]

    assert ended == [0, 0, 0]
    assert store.get("counter") == b"150"


@pytest.mark.parametrize("location", ["", "dir:", "ftp:x", "dir"])
def test_a_location_without_a_store_is_a_usage_error(location: str) -> None:
    with pytest.raises(UsageError, match="is not a store"):
        open_store(location)


def test_a_kind_that_the_caller_can_open_is_opened() -> None:
    store = MemoryStore()

    assert open_store("s3:maps", {"s3": lambda bucket: {"maps": store}[bucket]}) is store
    for location in ("s3:maps", "s3:"):
        with pytest.raises(UsageError, match="is not a store"):
            open_store(location)


@pytest.mark.parametrize(
    ("kind", "expected"), [("nothing", False), ("folder", False), ("file", True), ("dangling link", True)]
)
def test_only_what_is_there_and_no_folder_is_called_an_object(
    tmp_path: Path, kind: str, expected: bool
) -> None:
    """A folder that a remover took between two looks is made again."""
    path = tmp_path / "a"
    if kind == "folder":
        path.mkdir()
    elif kind == "file":
        path.write_bytes(b"")
    elif kind == "dangling link":
        path.symlink_to(tmp_path / "gone")

    assert _is_no_folder(str(path)) is expected
