"""Journals reach the bucket, also those of a machine that is gone, and an operator can read them."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

from rse_pf.aws.account import open_account
from rse_pf.aws.fleet.journal import make_batch
from rse_pf.aws.fleet.server_logs import console_of, last_lines, list_logged_servers
from rse_pf.aws.fleet.task import AgentConfig, AgentContext
from rse_pf.aws.fleet.tasks import journals
from rse_pf.aws.fleet.tasks.journals import JOURNAL_SHIP_S
from rse_pf.cli.main import main
from rse_pf.config import PlatformSettings
from rse_pf.storage.object_store import MemoryStore

BEGIN_US = 1_795_406_400_000_000


def entry(number: int, message: Any = None, **more: Any) -> bytes:
    told = {
        "__CURSOR": f"c{number}", "__REALTIME_TIMESTAMP": str(BEGIN_US + number * 1000),
        "_SYSTEMD_UNIT": "rse-pf.service", "MESSAGE": message if message is not None else f"line {number}",
        **more,
    }  # fmt: skip
    return json.dumps(told).encode() + b"\n"


class Machine:
    """A machine with a journal of some entries."""

    def __init__(self, count: int) -> None:
        self.entries = [entry(number) for number in range(count)]
        self.asked: list[str] = []

    def instance_id(self) -> str:
        return "i-1"

    def read(self, cursor: str) -> Iterable[bytes]:
        self.asked.append(cursor)
        return self.entries[int(cursor[1:]) + 1 if cursor else 0 :]


def context(machine: Machine, store: Any, folder: Path) -> AgentContext:
    config = AgentConfig(
        group="g", hook="h", keys_name="k", keys_file=folder / "keys.json", state_folder=folder
    )
    return AgentContext(
        machine=machine, clients={}, artifacts=store, config=config, settings=PlatformSettings(),  # type: ignore[arg-type]
        log=lambda *told, **more: None, journal=machine.read,
    )  # fmt: skip


def test_a_long_journal_becomes_several_pieces_and_no_line_is_lost_or_doubled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine, store = Machine(10), MemoryStore()
    monkeypatch.setattr(journals, "make_batch", lambda entries: make_batch(entries, 100))
    task = journals.task(context(machine, store, tmp_path))

    task.call()
    machine.entries += [entry(10), entry(11)]
    task.call()
    task.call()

    (server,) = list_logged_servers(store)
    assert len(server.pieces) > 3
    assert [line.partition(" rse-pf ")[2] for line in last_lines(store, server, 100)] == [
        f"line {number}" for number in range(12)
    ]
    assert last_lines(store, server, 2)[0].endswith("line 10")


def test_journals_are_shipped_in_every_phase_and_before_the_machine_ends(tmp_path: Path) -> None:
    from rse_pf.aws.fleet.agent import TASKS
    from rse_pf.aws.fleet.task import ALWAYS

    task = journals.task(context(Machine(0), MemoryStore(), tmp_path))

    assert journals.task in TASKS
    assert task.flushes
    assert task.phases == ALWAYS
    assert task.period_s == JOURNAL_SHIP_S


@pytest.fixture
def cloud(region: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """An account whose artifact bucket has journals of two servers."""
    monkeypatch.chdir(tmp_path)
    account = open_account(region)
    account.client("s3").create_bucket(
        Bucket="artifacts", CreateBucketConfiguration={"LocationConstraint": region}
    )
    monkeypatch.setattr(type(account), "resource", lambda self, stack, kind, prefix: "artifacts")
    monkeypatch.setattr("rse_pf.aws.account.open_account", lambda where: account)
    for server, at_us, text in (("i-1", BEGIN_US, "first\n"), ("i-2", BEGIN_US + 10**9, "a\nb\x1b[31m\nc\n")):
        name = journals.piece_name(server, at_us)
        account.client("s3").put_object(Bucket="artifacts", Key=name, Body=text.encode())
    account.client("s3").put_object(Bucket="artifacts", Key="journals/odd", Body=b"x")
    return account


def test_the_verb_lists_the_servers_and_shows_the_newest_lines(
    cloud: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["cloud", "logs"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["i-2", "i-1"]
    assert main(["cloud", "logs", "i-2", "--lines", "2"]) == 0
    assert capsys.readouterr().out == "b?[31m\nc\n", "a terminal obeys no line of a log"


def test_a_boot_that_shipped_nothing_is_read_from_the_console(
    cloud: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    image = cloud.client("ec2").describe_images()["Images"][0]["ImageId"]
    made = cloud.client("ec2").run_instances(ImageId=image, MinCount=1, MaxCount=1)
    server = made["Instances"][0]["InstanceId"]

    assert console_of(cloud, server)
    assert main(["cloud", "logs", server]) == 0
    assert main(["cloud", "logs", server, "--console"]) == 0
    capsys.readouterr()
    assert main(["cloud", "logs", "i-00000000000000000"]) == 1
    assert "has sent no journals" in capsys.readouterr().out


@pytest.mark.parametrize("wrong", [["--console"], ["i-1", "--lines", "0"], ["i-1", "--lines", "9999999"]])
def test_wrong_input_is_one_line_and_a_hint(
    cloud: Any, wrong: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["cloud", "logs", *wrong]) == 2
    assert "hint:" in capsys.readouterr().err
