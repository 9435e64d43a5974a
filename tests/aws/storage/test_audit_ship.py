"""The audit log on its way out of a machine: nothing is lost, nothing is written twice, harm is told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from rse_pf.audit.log import AuditLog, files_of
from rse_pf.audit.verify import Verdict, check_folder
from rse_pf.aws.clients import make_client
from rse_pf.aws.storage.audit_archive import fetch_audit, open_audit_archive
from rse_pf.aws.storage.audit_ship import Shipper, piece_name
from rse_pf.aws.storage.s3_store import S3Store
from rse_pf.errors import ConfigurationError, StoreError
from rse_pf.object_store import MemoryStore

INSTANCE = "i-0123456789abcdef0"
SMALL = 2_000
"""Bytes after which these logs are set aside: every few entries."""


class WriteOnly(MemoryStore):
    """A bucket as the role of a server has it: a new name may be written, and nothing else."""

    def __init__(self) -> None:
        super().__init__()
        self.is_away = False
        self.writes = 0

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        if self.is_away:
            raise StoreError("AWS does not answer")
        assert expected is None
        super().compare_and_swap(name, None, data)
        self.writes += 1


class Stand:
    """A folder with a log, its shipper, its bucket."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "audit"
        self.bucket = WriteOnly()
        self.told: list[tuple[str, str]] = []
        self.marks = folder / "shipped.json"
        self.shipper = self.made()

    def made(self) -> Shipper:
        return Shipper(
            self.folder, self.bucket, marks_file=self.marks, instance=lambda: INSTANCE,
            on_broken=lambda who, why: self.told.append((who, why)),
        )  # fmt: skip

    def write(self, count: int, who: str = INSTANCE) -> None:
        """Write so many entries, each to the disk by itself; files are set aside on the way."""
        log = AuditLog(self.folder, who, wall_clock=lambda: 1e9, max_bytes=SMALL, sync_s=0.0).open()
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
def stand(tmp_path: Path) -> Stand:
    return Stand(tmp_path)


def test_what_arrives_is_what_was_written_over_many_files_and_looks(stand: Stand, tmp_path: Path) -> None:
    for count in (1, 0, 30, 3):
        stand.write(count)
        stand.shipper.ship()
    assert len(files_of(stand.folder, INSTANCE)) > 3

    (verdict,) = stand.verdicts(tmp_path / "fetched").values()

    assert (verdict.problem, verdict.head) == ("", stand.here()[INSTANCE].head)
    assert verdict.entries == stand.here()[INSTANCE].entries
    assert stand.told == []


def test_a_look_at_nothing_new_writes_nothing(stand: Stand) -> None:
    stand.write(2)
    assert stand.shipper.ship() == 1
    writes = stand.bucket.writes

    assert stand.shipper.ship() == 0
    assert stand.made().ship() == 0, "the marks outlive the agent"
    assert stand.bucket.writes == writes


def test_a_bucket_that_is_away_gets_everything_when_it_is_back(stand: Stand, tmp_path: Path) -> None:
    stand.write(3)
    stand.shipper.ship()
    stand.bucket.is_away = True
    stand.write(20)
    with pytest.raises(StoreError):
        stand.shipper.ship()
    stand.bucket.is_away = False
    stand.shipper.ship()

    (verdict,) = stand.verdicts(tmp_path / "fetched").values()
    assert (verdict.problem, verdict.head) == ("", stand.here()[INSTANCE].head)


@pytest.mark.parametrize("more", [0, 25])
def test_lost_marks_send_it_again_and_the_reader_takes_each_entry_once(
    stand: Stand, tmp_path: Path, more: int
) -> None:
    stand.write(10)
    stand.shipper.ship()
    stand.marks.unlink()
    stand.write(more)
    stand.shipper.ship()

    (verdict,) = stand.verdicts(tmp_path / "fetched").values()
    assert (verdict.problem, verdict.entries) == ("", stand.here()[INSTANCE].entries)
    assert stand.told == []


def test_the_chains_of_two_writers_on_two_machines_stay_apart(stand: Stand, tmp_path: Path) -> None:
    stand.write(4)
    stand.write(5, who="data")
    stand.shipper.ship()
    other = Stand(tmp_path / "other")
    other.bucket = stand.bucket
    other.write(6, who="data")
    Shipper(
        other.folder, stand.bucket, marks_file=other.marks, instance=lambda: "i-2",
        on_broken=lambda who, why: None,
    ).ship()  # fmt: skip

    found = stand.verdicts(tmp_path / "fetched")

    assert {who: verdict.problem for who, verdict in found.items()} == {
        INSTANCE: "", f"{INSTANCE}_data": "", "i-2_data": "",
    }  # fmt: skip


def test_a_line_that_a_crash_tore_off_does_not_break_the_chain(stand: Stand, tmp_path: Path) -> None:
    stand.write(2)
    stand.shipper.ship()
    current = stand.folder / f"{INSTANCE}.jsonl"
    with current.open("ab") as file:
        file.write(b'{"seq":3,"ti')
    stand.shipper.ship()
    stand.write(2)
    stand.shipper.ship()
    assert stand.here()[INSTANCE].problem == ""

    (verdict,) = stand.verdicts(tmp_path / "fetched").values()
    assert (verdict.problem, verdict.head) == ("", stand.here()[INSTANCE].head)
    assert stand.told == []


def test_half_a_line_waits_for_its_other_half(stand: Stand) -> None:
    stand.write(1)
    current = stand.folder / f"{INSTANCE}.jsonl"
    whole = current.read_bytes()
    current.write_bytes(whole[:-10])
    assert stand.shipper.ship() == 0
    current.write_bytes(whole)

    assert stand.shipper.ship() == 1
    (name,) = [each.name for each in stand.bucket.list()]
    assert name == piece_name(INSTANCE, INSTANCE, 1, whole)


def test_an_entry_that_was_changed_before_it_was_sent_is_told_and_sent(stand: Stand, tmp_path: Path) -> None:
    stand.write(3)
    current = stand.folder / f"{INSTANCE}.jsonl"
    current.write_bytes(current.read_bytes().replace(b"robot-1", b"robot-9"))

    stand.shipper.ship()

    assert stand.told == [(INSTANCE, "entry 2 was changed: its hash is not that of what it says")]
    (verdict,) = stand.verdicts(tmp_path / "fetched").values()
    assert verdict.problem.startswith("entry 2 was changed")


def test_a_log_that_was_written_anew_after_it_was_sent_is_told(stand: Stand, tmp_path: Path) -> None:
    stand.write(5)
    stand.shipper.ship()
    (stand.folder / f"{INSTANCE}.jsonl").unlink()
    log = AuditLog(stand.folder, INSTANCE, wall_clock=lambda: 2e9, max_bytes=SMALL, sync_s=0.0).open()
    log.record("nothing.happened")
    log.close()
    stand.shipper.ship()

    assert stand.here()[INSTANCE].problem == "", "on the machine nothing shows"
    (verdict,) = stand.verdicts(tmp_path / "fetched").values()
    assert "entry 6 is missing" in verdict.problem or "entry 2 is missing" in verdict.problem


def test_a_file_that_was_cut_after_it_was_sent_is_told(stand: Stand, tmp_path: Path) -> None:
    stand.write(5)
    stand.shipper.ship()
    current = stand.folder / f"{INSTANCE}.jsonl"
    current.write_bytes(b"".join(current.read_bytes().splitlines(keepends=True)[:2]))
    stand.write(1)
    stand.shipper.ship()

    assert stand.here()[INSTANCE].problem == ""
    assert next(iter(stand.verdicts(tmp_path / "fetched").values())).problem != ""


def test_a_piece_that_is_not_there_is_a_missing_entry(stand: Stand, tmp_path: Path) -> None:
    for _ in range(3):
        stand.write(1)
        stand.shipper.ship()
    names = [each.name for each in stand.bucket.list()]
    stand.bucket.delete(names[1])

    (verdict,) = stand.verdicts(tmp_path / "fetched").values()

    assert verdict.problem.startswith("entry 2 is missing")


def test_a_piece_whose_bytes_were_changed_belies_its_name(stand: Stand, tmp_path: Path) -> None:
    stand.write(2)
    stand.shipper.ship()
    (name,) = [each.name for each in stand.bucket.list()]
    stand.bucket.put(name, b"")

    problems = fetch_audit(stand.bucket, tmp_path / "fetched")

    assert problems == [f"{name} was changed: its bytes are not those that its name vouches for"]


def test_what_is_no_piece_is_told_and_leaves_the_folder_alone(tmp_path: Path) -> None:
    bucket = MemoryStore()
    bucket.put("audit/i-1/..evil.jsonl".replace("..", "x."), b"x\n")

    problems = fetch_audit(bucket, tmp_path / "fetched")

    assert problems == ["audit/i-1/x.evil.jsonl is no piece of a log"]
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
    stand = Stand(tmp_path)
    stand.write(8)
    bucket = S3Store(locked, "audit-logs")
    shipper = Shipper(
        stand.folder, bucket, marks_file=stand.marks, instance=lambda: INSTANCE,
        on_broken=lambda who, why: None,
    )  # fmt: skip
    shipper.ship()
    stand.marks.unlink()
    shipper.ship()

    versions = locked.list_object_versions(Bucket="audit-logs")["Versions"]
    assert len(versions) == len({each["Key"] for each in versions}), "no name is written twice"
    held = locked.head_object(Bucket="audit-logs", Key=versions[0]["Key"])
    assert held["ObjectLockMode"] == "GOVERNANCE"
    assert fetch_audit(bucket, tmp_path / "fetched") == []
    (verdict,) = check_folder(tmp_path / "fetched")
    assert (verdict.problem, verdict.head) == ("", stand.here()[INSTANCE].head)


def test_a_deployment_without_the_bucket_says_to_deploy() -> None:
    class NoStack:
        region = "r"

        def pages(self, *words: str, **more: str) -> list[Any]:
            return [{"LogicalResourceId": "Artifacts1", "ResourceType": "AWS::S3::Bucket"}]

    with pytest.raises(ConfigurationError) as told:
        open_audit_archive(NoStack())  # type: ignore[arg-type]
    assert "cdk deploy" in told.value.hint
