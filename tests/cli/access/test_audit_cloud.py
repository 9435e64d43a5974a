"""`rse-pf audit --cloud`: what servers sent to the bucket, read back by an operator."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from rse_pf.audit.log import record_once
from rse_pf.aws.storage.audit_archive import Shipper
from rse_pf.aws.storage.s3_store import S3Store
from rse_pf.cli.main import main

Capture = pytest.CaptureFixture[str]


def sent(s3: Any, folder: Path, instance: str, *actions: str) -> None:
    """Have a server write entries and its agent send each by itself."""
    shipper = Shipper(
        folder / instance, S3Store(s3, "audit-logs"), marks_file=folder / f"{instance}.json",
        instance=lambda: instance, on_broken=lambda who, why: None,
    )  # fmt: skip
    for row, action in enumerate(actions):
        record_once(
            folder / instance, instance, action, "robot-1", wall_clock=lambda at=row: 1e9 + at,
        )  # fmt: skip
        shipper.ship()


@pytest.fixture
def two_servers(cloud: Any, tmp_path: Path) -> Any:
    sent(cloud, tmp_path, "i-1", "auth.accepted", "auth.cut-off", "server.drained")
    sent(cloud, tmp_path, "i-2", "auth.accepted")
    return cloud


def test_verify_judges_each_servers_chain(two_servers: Any, capsys: Capture) -> None:
    assert main(["audit", "verify", "--cloud"]) == 0

    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(",")[0] for line in lines] == ["i-1: 3 entries good", "i-2: 1 entry good"]


def test_a_deleted_part_is_detected(two_servers: Any, capsys: Capture) -> None:
    names = [each["Key"] for each in two_servers.list_objects_v2(Bucket="audit-logs")["Contents"]]
    two_servers.delete_object(Bucket="audit-logs", Key=names[1])

    assert main(["audit", "verify", "--cloud"]) == 1

    out = capsys.readouterr().out
    assert "i-1: BROKEN" in out
    assert "entry 2 is missing" in out


def test_truncation_is_detected_with_a_stored_head(two_servers: Any, capsys: Capture) -> None:
    main(["audit", "verify", "--cloud"])
    head = capsys.readouterr().out.splitlines()[0].rpartition(" ")[2]
    names = [each["Key"] for each in two_servers.list_objects_v2(Bucket="audit-logs")["Contents"]]
    two_servers.delete_object(Bucket="audit-logs", Key=names[2])
    assert main(["audit", "verify", "--cloud"]) == 0

    assert main(["audit", "verify", "--cloud", "--head", f"i-1={head}"]) == 1


def test_a_part_with_other_bytes_is_detected(two_servers: Any, capsys: Capture) -> None:
    name = two_servers.list_objects_v2(Bucket="audit-logs")["Contents"][0]["Key"]
    two_servers.put_object(Bucket="audit-logs", Key=name, Body=b"")

    assert main(["audit", "verify", "--cloud"]) == 1
    assert f"BROKEN: {name} was changed" in capsys.readouterr().out
    assert main(["audit", "show", "--cloud", "--json"]) == 1
    told = capsys.readouterr()
    assert [json.loads(line)["seq"] for line in told.out.splitlines()] != []
    assert "BROKEN" in told.err


def test_show_prints_all_servers_in_order_and_keeps_the_files(two_servers: Any, capsys: Capture) -> None:
    assert main(["audit", "show", "--cloud", "--out", "kept", "--only", "auth"]) == 0
    here = capsys.readouterr().out
    assert [line.split()[2] for line in here.splitlines()] == ["i-1#1", "i-2#1", "i-1#2"]

    assert main(["audit", "show", "kept", "--only", "auth"]) == 0
    assert capsys.readouterr().out == here
    assert main(["audit", "verify", "kept"]) == 0


@pytest.mark.parametrize(
    ("words", "first"),
    [
        (["verify", "--cloud"], "holds no audit log yet"),
        (["verify", "somewhere", "--cloud"], "exclude each other"),
        (["verify", "--out", "x"], "--out is for --cloud"),
        (["show", "--cloud", "--out", "full"], "not empty"),
    ],
)
def test_bad_input_is_one_line_and_a_hint(cloud: Any, capsys: Capture, words: list[str], first: str) -> None:
    Path("full").mkdir()
    Path("full/file").write_text("")

    assert main(["audit", *words]) == 2
    error = capsys.readouterr().err
    assert first in error
    assert error.count("\n  hint: ") == 1
