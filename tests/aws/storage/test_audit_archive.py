"""The upload of audit logs: no entry is lost, and each is read once."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import pytest
from botocore.exceptions import ClientError

from rse_pf.audit.log import AuditLog, log_files, log_names, read_entries
from rse_pf.aws.clients import MAX_TRIES, make_client
from rse_pf.aws.storage.audit_archive import Shipper, fetch_audit
from rse_pf.aws.storage.s3_store import S3Store
from rse_pf.errors import StoreError
from rse_pf.storage.object_store import MemoryStore, ObjectStore

INSTANCE = "i-0123456789abcdef0"
SMALL = 2_000
"""Bytes after which these files are renamed: every few entries."""


class WriteOnly(MemoryStore):
    """A bucket as the role of a server has it: a new name may be written, and nothing else."""

    def __init__(self) -> None:
        super().__init__()
        self.is_down = False

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        if self.is_down:
            raise StoreError("AWS does not answer")
        assert expected is None
        super().compare_and_swap(name, None, data)


def subjects(folder: Path) -> dict[str, list[int]]:
    """Return the subjects of all entries of each log in *folder*."""
    return {
        who: [int(entry.subject) for path in log_files(folder, who) for entry in read_entries(path)]
        for who in log_names(folder)
    }


class ShipperSetup:
    """A folder with a log, its shipper, its bucket."""

    def __init__(self, folder: Path, bucket: ObjectStore | None = None, instance: str = INSTANCE) -> None:
        self.folder = folder / "audit"
        self.bucket = WriteOnly() if bucket is None else bucket
        self.marks = folder / "shipped.json"
        self.instance = instance
        self.written = 0

    def ship(self) -> int:
        """Upload by a shipper that was just started."""
        return Shipper(
            self.folder, self.bucket, marks_file=self.marks, instance=lambda: self.instance
        ).ship()  # fmt: skip

    def write(self, count: int, who: str = INSTANCE) -> None:
        """Write *count* entries with ascending subjects; files are renamed on the way."""
        log = AuditLog(
            self.folder, who, wall_clock=lambda: 1e9 + self.written, on_problem=pytest.fail, max_bytes=SMALL
        ).open()
        for _ in range(count):
            log.record("auth.accepted", str(self.written))
            self.written += 1
        log.close()

    def fetched(self, folder: Path) -> dict[str, list[int]]:
        """Return the subjects that an operator finds who fetches the bucket into the new *folder*."""
        fetch_audit(self.bucket, folder)
        return subjects(folder)


@pytest.fixture
def setup(tmp_path: Path) -> ShipperSetup:
    return ShipperSetup(tmp_path)


def test_the_bucket_gets_what_was_written_over_many_files_and_uploads(
    setup: ShipperSetup, tmp_path: Path
) -> None:
    for count in (1, 0, 40, 3):
        setup.write(count)
        setup.ship()
    assert len(log_files(setup.folder, INSTANCE)) > 2

    assert setup.fetched(tmp_path / "fetched") == {INSTANCE: list(range(44))}
    assert setup.ship() == 0, "without new entries nothing is uploaded"


def test_an_unreachable_bucket_gets_everything_when_it_is_back(setup: ShipperSetup, tmp_path: Path) -> None:
    setup.write(3)
    setup.ship()
    setup.bucket.is_down = True  # type: ignore[attr-defined]
    setup.write(40)
    with pytest.raises(StoreError):
        setup.ship()
    setup.bucket.is_down = False  # type: ignore[attr-defined]
    setup.ship()

    assert setup.fetched(tmp_path / "fetched") == {INSTANCE: list(range(43))}


@pytest.mark.parametrize("more", [0, 25])
def test_after_lost_marks_all_is_uploaded_again_and_each_entry_is_read_once(
    setup: ShipperSetup, tmp_path: Path, more: int
) -> None:
    setup.write(10)
    setup.ship()
    setup.marks.unlink()
    setup.write(more)
    setup.ship()

    assert setup.fetched(tmp_path / "fetched") == {INSTANCE: list(range(10 + more))}


def test_the_pieces_of_version_0_1_are_read(setup: ShipperSetup, tmp_path: Path) -> None:
    line = b'{"action":"x","actor":"i-1","detail":{},"hash":"9a","seq":1,"subject":"7","time":1}\n'
    setup.bucket.put(f"audit/i-1/i-1.000000000001.{'a' * 32}.jsonl", line)
    setup.bucket.put("audit/i-1/foreign.jsonl", line)

    assert setup.fetched(tmp_path / "fetched") == {"i-1": [7]}


# --- with the emulator -----------------------------------------------------------------------------


@pytest.fixture
def locked(region: str) -> Any:
    """S3 with a bucket as the data stack makes it."""
    s3 = make_client("s3", region)
    s3.create_bucket(
        Bucket="audit-logs",
        CreateBucketConfiguration={"LocationConstraint": region},
        ObjectLockEnabledForBucket=True,
    )
    rule = {"DefaultRetention": {"Mode": "GOVERNANCE", "Days": 365}}
    s3.put_object_lock_configuration(
        Bucket="audit-logs", ObjectLockConfiguration={"ObjectLockEnabled": "Enabled", "Rule": rule}
    )
    return s3


def test_pieces_in_a_locked_bucket_are_kept_and_read_back(locked: Any, tmp_path: Path) -> None:
    setup = ShipperSetup(tmp_path, S3Store(locked, "audit-logs"))
    setup.write(8)
    setup.ship()
    setup.marks.unlink()
    setup.ship()

    versions = locked.list_object_versions(Bucket="audit-logs")["Versions"]
    assert len(versions) == len({each["Key"] for each in versions}), "no name is written twice"
    held = locked.head_object(Bucket="audit-logs", Key=versions[0]["Key"])
    assert held["ObjectLockMode"] == "GOVERNANCE"
    assert setup.fetched(tmp_path / "fetched") == {INSTANCE: list(range(8))}


@pytest.mark.parametrize("times", [1, MAX_TRIES, 2 * MAX_TRIES])
def test_a_piece_that_s3_answered_with_409_is_not_lost(locked: Any, tmp_path: Path, times: int) -> None:
    class Undecided:
        """S3 while another write of the same name is not finished; that one fails, and nothing is stored."""

        left = times

        def __getattr__(self, name: str) -> Any:
            return getattr(locked, name)

        def put_object(self, **arguments: Any) -> Any:
            if self.left:
                self.left -= 1
                told = {"HTTPStatusCode": 409}
                raise ClientError(
                    {"Error": {"Code": "ConditionalRequestConflict"}, "ResponseMetadata": told}, "PutObject"
                )  # fmt: skip
            return locked.put_object(**arguments)

    setup = ShipperSetup(tmp_path, S3Store(Undecided(), "audit-logs"))
    setup.write(8)
    for _ in range(3):  # as the agent calls it
        with contextlib.suppress(StoreError):
            setup.ship()

    assert setup.fetched(tmp_path / "fetched") == {INSTANCE: list(range(8))}
