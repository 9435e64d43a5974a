"""The agent's duties: numbers in every period, keys when they change, the drain once."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from aws.fleet.fake_machine import FakeMachine, FakeScaling

from rse_pf.audit.log import record_once
from rse_pf.audit.verify import check_folder
from rse_pf.auth.tokens import SigningKey
from rse_pf.auth.trust_store import DENY_NAME, AccessControlStore
from rse_pf.aws.clients import make_client
from rse_pf.aws.fleet.agent import Agent, AgentConfig, main
from rse_pf.aws.storage.audit_archive import fetch_audit
from rse_pf.aws.storage.audit_ship import Shipper
from rse_pf.config import PlatformSettings
from rse_pf.errors import StoreError
from rse_pf.object_store import MemoryStore
from rse_pf.scaling.alarms import NAMESPACE

KEYS = SigningKey.from_seed(b"k" * 32, "test-key").key_set().to_json().encode()
PAGE = 'rse_pf_requests_total{{result="ok",service="pnp"}} {requests}\nrse_pf_robots {robots}\n'


class Stand:
    """An agent with everything around it."""

    def __init__(self, folder: Path, cloudwatch: Any) -> None:
        self.machine = FakeMachine()
        self.scaling = FakeScaling(self.machine)
        self.artifacts = MemoryStore()
        self.file = folder / "keys.json"
        self.log: list[tuple[str, dict[str, Any]]] = []
        self.audit, self.archive = folder / "audit", MemoryStore()
        shipper = Shipper(
            self.audit, self.archive, marks_file=folder / "shipped.json", instance=self.machine.instance_id,
            on_broken=lambda who, why: self.log.append(("broken", {"who": who})),
        )  # fmt: skip
        self.agent = Agent(
            self.machine, cloudwatch=cloudwatch, autoscaling=self.scaling, artifacts=self.artifacts,
            post=AgentConfig(group="rse-pf", hook="drain", keys_name="keys.json", keys_file=self.file),
            settings=PlatformSettings(), clock=self.machine.clock, rest=self.machine.rest,
            log=lambda event, **fields: self.log.append((event, fields)), shipper=shipper,
        )  # fmt: skip

    def note(self, action: str) -> None:
        """Have the server write an entry."""
        record_once(self.audit, self.machine.instance_id(), action, wall_clock=lambda: 1e9, max_bytes=1 << 20)

    def archived(self) -> int:
        """Return the number of entries that are safe in the bucket, in whole chains."""
        folder = self.audit.with_name(f"fetched-{len(list(self.audit.parent.iterdir()))}")
        assert fetch_audit(self.archive, folder) == []
        verdicts = check_folder(folder)
        assert [each.problem for each in verdicts] == [""] * len(verdicts)
        return sum(each.entries for each in verdicts)

    def events(self) -> list[str]:
        return [event for event, _ in self.log]


class Counting:
    """CloudWatch that remembers."""

    def __init__(self) -> None:
        self.told: list[dict[str, Any]] = []

    def put_metric_data(self, **arguments: Any) -> dict[str, Any]:
        self.told.append(arguments)
        return {}


@pytest.fixture
def stand(tmp_path: Path) -> Stand:
    return Stand(tmp_path, Counting())


def test_the_emulator_takes_the_numbers_under_the_alarms_names(tmp_path: Path, region: str) -> None:
    cloudwatch = make_client("cloudwatch", region)
    stand = Stand(tmp_path, cloudwatch)
    for requests in (10, 17):
        stand.machine.text = PAGE.format(requests=requests, robots=3)
        stand.agent.step()
        stand.machine.rest(60.0)

    now = datetime.now(timezone.utc)

    def total(name: str, statistic: str) -> float:
        found = cloudwatch.get_metric_statistics(
            Namespace=NAMESPACE, MetricName=name, Period=3600, Statistics=[statistic],
            Dimensions=[{"Name": "AutoScalingGroupName", "Value": "rse-pf"}],
            StartTime=now - timedelta(hours=1), EndTime=now + timedelta(hours=1),
        )  # fmt: skip
        return sum(point[statistic] for point in found["Datapoints"])

    assert total("Requests", "Sum") == 7, "what came before the agent is not this period's"
    assert total("Robots", "Maximum") == 3
    assert "failed" not in stand.events()


def test_numbers_are_told_once_in_a_period(tmp_path: Path) -> None:
    counting = Counting()
    stand = Stand(tmp_path, counting)
    stand.machine.text = PAGE.format(requests=0, robots=0)

    for _ in range(24):  # two minutes of looks
        stand.agent.step()
        stand.machine.rest(5.0)

    assert len(counting.told) == 2
    assert {each["Namespace"] for each in counting.told} == {NAMESPACE}


def test_without_keys_robots_are_refused_and_one_line_says_so(stand: Stand) -> None:
    for _ in range(3):
        stand.agent.step()
        stand.machine.rest(60.0)

    assert stand.file.read_text() == '{"keys":[]}\n'
    assert stand.events().count("no-keys") == 1


def test_keys_are_written_when_they_appear_and_when_they_change(stand: Stand) -> None:
    stand.agent.fetch_keys()
    stand.artifacts.put("keys.json", KEYS)
    stand.agent.fetch_keys()
    first = stand.file.stat().st_ino
    stand.agent.fetch_keys()

    assert stand.file.read_bytes() == KEYS
    assert stand.file.stat().st_ino == first, "written again without a change"
    assert stand.events() == ["no-keys", "keys"]


def test_what_is_no_key_set_does_not_replace_the_keys(stand: Stand) -> None:
    stand.artifacts.put("keys.json", KEYS)
    stand.agent.fetch_keys()
    stand.artifacts.put("keys.json", b"<html>sorry</html>")
    stand.agent.step()

    assert stand.file.read_bytes() == KEYS
    assert ("failed", "keys") in [(event, fields.get("duty")) for event, fields in stand.log]


def test_keys_that_vanish_from_the_bucket_stay_on_the_server(stand: Stand) -> None:
    stand.artifacts.put("keys.json", KEYS)
    stand.agent.fetch_keys()
    stand.artifacts.delete("keys.json")
    stand.agent.fetch_keys()

    assert stand.file.read_bytes() == KEYS


def test_a_leaving_instance_drains_once_and_tells_nothing_more(tmp_path: Path) -> None:
    counting = Counting()
    stand = Stand(tmp_path, counting)
    stand.machine.leaving = True

    for _ in range(30):
        stand.agent.step()
        stand.machine.rest(5.0)

    assert len(stand.scaling.completed) == 1
    assert len(stand.machine.waits) == 1
    assert counting.told == []


def test_a_refused_hook_is_tried_again(stand: Stand) -> None:
    class Refusing:
        def complete_lifecycle_action(self, **arguments: Any) -> None:
            from botocore.exceptions import ClientError

            raise ClientError({"Error": {"Code": "ValidationError"}}, "CompleteLifecycleAction")

    stand.machine.leaving = True
    stand.agent._autoscaling, working = Refusing(), stand.scaling
    stand.agent.step()
    assert not stand.agent.has_left
    stand.agent._autoscaling = working
    stand.agent.step()

    assert stand.agent.has_left
    assert len(working.completed) == 1


def test_a_server_that_is_down_fails_one_duty_alone(stand: Stand) -> None:
    stand.machine.runs = False
    stand.artifacts.put("keys.json", KEYS)

    stand.agent.step()

    assert stand.file.read_bytes() == KEYS
    assert [fields["duty"] for event, fields in stand.log if event == "failed"] == ["metrics"]


def test_a_missing_settings_file_is_two_lines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    place = ["--bucket", "b", "--keys-name", "k", "--keys-file", "k", "--group", "g", "--hook", "h"]

    assert main(["--settings", str(tmp_path / "none.json"), *place]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2


def test_the_control_room_is_fetched_beside_the_keys_when_it_changes(stand: Stand) -> None:
    room = AccessControlStore(stand.artifacts)
    stand.agent.fetch_control()
    assert not (stand.file.parent / DENY_NAME).exists()

    room.change_denied(lambda denied: denied.with_robot("default", "r", 1.0))
    stand.agent.fetch_control()
    stand.agent.fetch_control()

    assert (stand.file.parent / DENY_NAME).read_bytes() == stand.artifacts.get(DENY_NAME)
    assert stand.events() == ["control"]


@pytest.mark.parametrize("harm", ["nonsense", "gone"])
def test_a_control_room_that_was_spoilt_changes_nothing_on_the_machine(stand: Stand, harm: str) -> None:
    AccessControlStore(stand.artifacts).change_denied(lambda denied: denied.with_robot("default", "r", 1.0))
    stand.agent.fetch_control()
    good = (stand.file.parent / DENY_NAME).read_bytes()
    if harm == "gone":
        stand.artifacts.delete(DENY_NAME)
    else:
        stand.artifacts.put(DENY_NAME, b"nonsense")

    class Enough(Exception):
        pass

    def stop(_: float) -> None:
        raise Enough

    with pytest.raises(Enough):
        stand.agent.watch_control(stop)

    assert (stand.file.parent / DENY_NAME).read_bytes() == good
    assert stand.events() == ["control"] + ["failed"] * (harm == "nonsense")


def test_the_audit_log_is_sent_in_its_own_period_and_only_when_something_is_new(stand: Stand) -> None:
    stand.note("first")
    stand.agent.step()
    assert stand.archived() == 1
    stand.note("second")
    stand.agent.step()
    assert stand.archived() == 1, "not before its time"
    stand.machine.rest(60.0)
    stand.agent.step()
    stand.machine.rest(60.0)
    stand.agent.step()

    assert stand.archived() == 2
    assert stand.events().count("shipped") == 2


def test_what_a_server_writes_while_it_leaves_is_sent_before_the_hook_is_completed(tmp_path: Path) -> None:
    stand = Stand(tmp_path, Counting())
    stand.note("lived")
    stand.machine.leaving = True
    drain, complete = stand.machine.drain, stand.scaling.complete_lifecycle_action
    safe: list[int] = []

    def drained(wait_s: float) -> None:
        stand.note("drained")
        drain(wait_s)

    def completed(**arguments: Any) -> dict[str, Any]:
        safe.append(stand.archived())
        return complete(**arguments)

    stand.machine.drain = drained  # type: ignore[method-assign]
    stand.scaling.complete_lifecycle_action = completed  # type: ignore[method-assign]
    stand.agent.step()

    assert safe == [2]
    assert stand.agent.has_left


def test_a_bucket_that_is_away_keeps_no_instance_from_leaving(
    stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    def away(*_: Any) -> None:
        raise StoreError("AWS does not answer")

    monkeypatch.setattr(stand.archive, "compare_and_swap", away)
    stand.note("lived")
    stand.machine.leaving = True
    stand.agent.step()

    assert len(stand.scaling.completed) == 1
    assert [fields["duty"] for event, fields in stand.log if event == "failed"].count("audit") == 3
