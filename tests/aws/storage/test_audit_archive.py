"""The upload of audit logs: nothing is lost, nothing is written twice, changes are detected."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import pytest
from botocore.exceptions import ClientError

from rse_pf.audit.log import AuditBounds, AuditLog, files_of
from rse_pf.audit.verify import Verdict, check_folder
from rse_pf.aws.account import Account
from rse_pf.aws.clients import MAX_TRIES, make_client
from rse_pf.aws.storage.audit_archive import Shipper, fetch_audit, open_audit_archive, piece_name
from rse_pf.aws.storage.s3_store import S3Store
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import ConfigurationError, StoreError
from rse_pf.object_store import MemoryStore

INSTANCE = "i-0123456789abcdef0"
SMALL = 2_000
"""Bytes after which these logs are set aside: every few entries."""


class WriteOnly(MemoryStore):
    """A bucket as the role of a server has it: a new name may be written, and nothing else."""

    def __init__(self) -> None:
        super().__init__()
        self.is_down = False
        self.writes = 0

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        if self.is_down:
            raise StoreError("AWS does not answer")
        assert expected is None
        super().compare_and_swap(name, None, data)
        self.writes += 1


class ShipperSetup:
    """A folder with a log, its shipper, its bucket."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "audit"
        self.bucket = WriteOnly()
        self.problems: list[tuple[str, str]] = []
        self.marks = folder / "shipped.json"
        self.shipper = self.made()

    def made(self) -> Shipper:
        return Shipper(
            self.folder, self.bucket, marks_file=self.marks, instance=lambda: INSTANCE,
            on_broken=lambda chain, problem: self.problems.append((chain, problem)),
        )  # fmt: skip

    def write(self, count: int, who: str = INSTANCE) -> None:
        """Write so many entries, each to the disk by itself; files are set aside on the way."""
        log = AuditLog(
            self.folder, who, wall_clock=lambda: 1e9, bounds=AuditBounds(max_bytes=SMALL, sync_s=0.0)
        ).open()
        for number in range(count):
            log.record("auth.accepted", f"robot-{number}")
            log.flush()
        log.close()

    def verdicts(self, folder: Path) -> dict[str, Verdict]:
        """Return what an operator finds who fetches the bucket into the new *folder*."""
        assert fetch_audit(self.bucket, folder) == []
        return {each.who: each for each in check_folder(folder)}

    def here(self) -> dict[str, Verdict]:
        return {each.who: each for each in check_folder(self.folder)}


@pytest.fixture
def setup(tmp_path: Path) -> ShipperSetup:
    return ShipperSetup(tmp_path)


def test_the_bucket_gets_what_was_written_over_many_files_and_uploads(
    setup: ShipperSetup, tmp_path: Path
) -> None:
    for count in (1, 0, 30, 3):
        setup.write(count)
        setup.shipper.ship()
    assert len(files_of(setup.folder, INSTANCE)) > 3

    (verdict,) = setup.verdicts(tmp_path / "fetched").values()

    assert (verdict.problem, verdict.head) == ("", setup.here()[INSTANCE].head)
    assert verdict.entries == setup.here()[INSTANCE].entries
    assert setup.problems == []


def test_without_new_entries_nothing_is_uploaded(setup: ShipperSetup) -> None:
    setup.write(2)
    assert setup.shipper.ship() == 1
    writes = setup.bucket.writes

    assert setup.shipper.ship() == 0
    assert setup.made().ship() == 0, "the marks survive the agent"
    assert setup.bucket.writes == writes


def test_an_unreachable_bucket_gets_everything_when_it_is_back(setup: ShipperSetup, tmp_path: Path) -> None:
    setup.write(3)
    setup.shipper.ship()
    setup.bucket.is_down = True
    setup.write(20)
    with pytest.raises(StoreError):
        setup.shipper.ship()
    setup.bucket.is_down = False
    setup.shipper.ship()

    (verdict,) = setup.verdicts(tmp_path / "fetched").values()
    assert (verdict.problem, verdict.head) == ("", setup.here()[INSTANCE].head)


@pytest.mark.parametrize("more", [0, 25])
def test_after_lost_marks_all_is_uploaded_again_and_each_entry_is_read_once(
    setup: ShipperSetup, tmp_path: Path, more: int
) -> None:
    setup.write(10)
    setup.shipper.ship()
    setup.marks.unlink()
    setup.write(more)
    setup.shipper.ship()

    (verdict,) = setup.verdicts(tmp_path / "fetched").values()
    assert (verdict.problem, verdict.entries) == ("", setup.here()[INSTANCE].entries)
    assert setup.problems == []


def test_the_chains_of_two_writers_on_two_machines_stay_apart(setup: ShipperSetup, tmp_path: Path) -> None:
    setup.write(4)
    setup.write(5, who="data")
    setup.shipper.ship()
    other = ShipperSetup(tmp_path / "other")
    other.bucket = setup.bucket
    other.write(6, who="data")
    Shipper(
        other.folder, setup.bucket, marks_file=other.marks, instance=lambda: "i-2",
        on_broken=lambda chain, problem: None,
    ).ship()  # fmt: skip

    found = setup.verdicts(tmp_path / "fetched")

    assert {who: verdict.problem for who, verdict in found.items()} == {
        INSTANCE: "", f"{INSTANCE}_data": "", "i-2_data": "",
    }  # fmt: skip


def test_a_line_cut_by_a_crash_does_not_break_the_chain(setup: ShipperSetup, tmp_path: Path) -> None:
    setup.write(2)
    setup.shipper.ship()
    current = setup.folder / f"{INSTANCE}.jsonl"
    with current.open("ab") as file:
        file.write(b'{"seq":3,"ti')
    setup.shipper.ship()
    setup.write(2)
    setup.shipper.ship()
    assert setup.here()[INSTANCE].problem == ""

    (verdict,) = setup.verdicts(tmp_path / "fetched").values()
    assert (verdict.problem, verdict.head) == ("", setup.here()[INSTANCE].head)
    assert setup.problems == []


def test_an_incomplete_line_is_uploaded_when_it_is_complete(setup: ShipperSetup) -> None:
    setup.write(1)
    current = setup.folder / f"{INSTANCE}.jsonl"
    whole = current.read_bytes()
    current.write_bytes(whole[:-10])
    assert setup.shipper.ship() == 0
    current.write_bytes(whole)

    assert setup.shipper.ship() == 1
    (name,) = [each.name for each in setup.bucket.list()]
    assert name == piece_name(INSTANCE, INSTANCE, 1, whole)


def test_an_entry_changed_before_its_upload_is_reported_and_uploaded(
    setup: ShipperSetup, tmp_path: Path
) -> None:
    setup.write(3)
    current = setup.folder / f"{INSTANCE}.jsonl"
    current.write_bytes(current.read_bytes().replace(b"robot-1", b"robot-9"))

    setup.shipper.ship()

    assert setup.problems == [(INSTANCE, "entry 2 was changed: its hash does not match its content")]
    (verdict,) = setup.verdicts(tmp_path / "fetched").values()
    assert verdict.problem.startswith("entry 2 was changed")


def test_a_log_rewritten_after_its_upload_is_detected(setup: ShipperSetup, tmp_path: Path) -> None:
    setup.write(5)
    setup.shipper.ship()
    for name in (f"{INSTANCE}.jsonl", "heads"):
        (setup.folder / name).unlink()
    log = AuditLog(
        setup.folder, INSTANCE, wall_clock=lambda: 2e9, bounds=AuditBounds(max_bytes=SMALL, sync_s=0.0)
    ).open()
    log.record("nothing.happened")
    log.close()
    setup.shipper.ship()

    assert setup.here()[INSTANCE].problem == "", "on the machine nothing shows"
    (verdict,) = setup.verdicts(tmp_path / "fetched").values()
    assert "entry 6 is missing" in verdict.problem or "entry 2 is missing" in verdict.problem


def test_a_file_truncated_after_its_upload_is_detected(setup: ShipperSetup, tmp_path: Path) -> None:
    setup.write(5)
    setup.shipper.ship()
    current = setup.folder / f"{INSTANCE}.jsonl"
    current.write_bytes(b"".join(current.read_bytes().splitlines(keepends=True)[:2]))
    (setup.folder / "heads").unlink()
    setup.write(1)
    setup.shipper.ship()

    assert setup.here()[INSTANCE].problem == ""
    assert next(iter(setup.verdicts(tmp_path / "fetched").values())).problem != ""


def test_a_foreign_object_is_reported_and_writes_nothing(tmp_path: Path) -> None:
    bucket = MemoryStore()
    bucket.put("audit/i-1/..evil.jsonl".replace("..", "x."), b"x\n")

    problems = fetch_audit(bucket, tmp_path / "fetched")

    assert problems == ["audit/i-1/x.evil.jsonl is not a piece of an audit log"]
    assert list((tmp_path / "fetched").iterdir()) == []


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
    setup = ShipperSetup(tmp_path)
    setup.write(8)
    bucket = S3Store(locked, "audit-logs")
    shipper = Shipper(
        setup.folder, bucket, marks_file=setup.marks, instance=lambda: INSTANCE,
        on_broken=lambda chain, problem: None,
    )  # fmt: skip
    shipper.ship()
    setup.marks.unlink()
    shipper.ship()

    versions = locked.list_object_versions(Bucket="audit-logs")["Versions"]
    assert len(versions) == len({each["Key"] for each in versions}), "no name is written twice"
    held = locked.head_object(Bucket="audit-logs", Key=versions[0]["Key"])
    assert held["ObjectLockMode"] == "GOVERNANCE"
    assert fetch_audit(bucket, tmp_path / "fetched") == []
    (verdict,) = check_folder(tmp_path / "fetched")
    assert (verdict.problem, verdict.head) == ("", setup.here()[INSTANCE].head)


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

    setup = ShipperSetup(tmp_path)
    setup.write(8)
    shipper = Shipper(
        setup.folder, S3Store(Undecided(), "audit-logs"), marks_file=setup.marks, instance=lambda: INSTANCE,
        on_broken=lambda chain, problem: None,
    )  # fmt: skip
    for _ in range(3):  # as the agent calls it
        with contextlib.suppress(StoreError):
            shipper.ship()

    assert fetch_audit(S3Store(locked, "audit-logs"), tmp_path / "fetched") == []
    (verdict,) = check_folder(tmp_path / "fetched")
    assert (verdict.problem, verdict.entries) == ("", setup.here()[INSTANCE].entries)


def test_a_deployment_without_the_bucket_says_to_deploy() -> None:
    class NoLogs:
        def can_paginate(self, method: str) -> bool:
            return False

        def list_stack_resources(self, **_: str) -> dict[str, Any]:
            row = {"LogicalResourceId": "Artifacts1", "ResourceType": "AWS::S3::Bucket"}
            return {"StackResourceSummaries": [row]}

    with pytest.raises(ConfigurationError) as told:
        open_audit_archive(Account("r", lambda service, region: NoLogs()), ResourceNames())
    assert "rse-pf cloud up" in told.value.hint
