"""The budget of the burst function: exact over all executions, also if one dies, and closed when in doubt."""

from __future__ import annotations

import hashlib
import json
import threading
import urllib.request
from collections.abc import Callable
from datetime import datetime, timezone

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from lambda_pnp.day_budget import BucketAccess, DayBudget, claim_in_bucket
from lambda_pnp.keys import signed_request
from rse_pf.config import BurstSettings
from rse_pf.errors import Busy, QuotaExceeded
from rse_pf.identity import RobotId

ENVIRONMENT = {
    "RSE_PF_KEYS": "artifacts/keys.json", "AWS_REGION": "ap-northeast-2", "AWS_ACCESS_KEY_ID": "AKIDEXAMPLE",
    "AWS_SECRET_ACCESS_KEY": "secret", "AWS_SESSION_TOKEN": "session",
}  # fmt: skip
NOON = datetime(2026, 11, 23, 12, tzinfo=timezone.utc)
NOON_S = NOON.timestamp()
ROBOT, OTHER = RobotId("default", "robot-1"), RobotId("other", "robot-1")


class Bucket:
    """S3 as far as the budget needs it: GET, and PUT with If-Match or If-None-Match."""

    def __init__(self, *, missing: int = 404) -> None:
        self.body: bytes | None = None
        self.puts = 0
        self.down = False
        self.before_put: Callable[[], None] = lambda: None
        self._missing = missing
        self._lock = threading.Lock()

    def send(self, request: urllib.request.Request) -> tuple[int, str, bytes]:
        if self.down:
            raise OSError("no route")
        assert request.full_url == "https://artifacts.s3.ap-northeast-2.amazonaws.com/burst/budget.json"
        if request.get_method() == "PUT":
            self.before_put()
        with self._lock:
            etag = "" if self.body is None else f'"{hashlib.md5(self.body).hexdigest()}"'
            if request.get_method() == "GET":
                return (200, etag, self.body) if self.body is not None else (self._missing, "", b"")
            wanted, absent = request.get_header("If-match"), request.get_header("If-none-match")
            assert (wanted is None) != (absent is None), "a write without a condition loses a lease"
            if (absent == "*" and self.body is not None) or (wanted is not None and wanted != etag):
                return 412, "", b""
            assert isinstance(request.data, bytes)
            self.body = request.data
            self.puts += 1
            return 200, "", b""

    def claim(self, day: str, wanted: int, most: int) -> int:
        return claim_in_bucket(ENVIRONMENT, day, wanted, most, BucketAccess(now=lambda: NOON, send=self.send))


def budget(bucket: Bucket, *, robot: int = 10**6, every: int = 10**6) -> DayBudget:
    settings = BurstSettings(robot_commands_per_day=robot, commands_per_day=every)
    return DayBudget(settings, bucket.claim)


def taken(of: DayBudget, tries: int, *, robot: RobotId = ROBOT, now_s: float = NOON_S) -> int:
    done = 0
    for _ in range(tries):
        try:
            of.take(robot, now_s)
        except QuotaExceeded:
            continue
        done += 1
    return done


@pytest.mark.parametrize("missing", [403, 404])
def test_all_executions_together_spend_the_budget_of_the_day_and_no_more(missing: int) -> None:
    bucket = Bucket(missing=missing)
    executions = [budget(bucket, every=1000) for _ in range(20)]

    assert sum(taken(each, 100) for each in executions) == 1000
    assert bucket.body is not None
    assert json.loads(bucket.body) == {"day": "2026-11-23", "granted": 1000}


@given(st.lists(st.integers(0, 70), max_size=12), st.integers(1, 300))
@hypothesis_settings(max_examples=25, deadline=None)
def test_executions_that_end_early_only_lose_commands(uses: list[int], most: int) -> None:
    bucket = Bucket()

    assert sum(taken(budget(bucket, every=most), use) for use in uses) <= most


def test_executions_that_claim_at_the_same_moment_do_not_get_the_same_lease() -> None:
    bucket = Bucket()
    first, second = budget(bucket, every=400), budget(bucket, every=400)
    second.take(ROBOT, NOON_S)

    def meanwhile() -> None:
        bucket.before_put = lambda: None
        assert taken(second, 2) == 2

    bucket.before_put = meanwhile
    first.take(ROBOT, NOON_S)

    assert bucket.body is not None
    assert json.loads(bucket.body)["granted"] == 6, "three leases of two"


@pytest.mark.parametrize(("others", "is_granted"), [(5, True), (6, False)])
def test_an_execution_whose_lease_is_taken_by_others_waits_longer_each_time(
    others: int, is_granted: bool
) -> None:
    bucket, left, waits = Bucket(), others, list[float]()

    def meanwhile() -> None:
        nonlocal left
        if left:
            left -= 1
            with_others = {"day": "2026-11-23", "granted": others - left}
            bucket.body = json.dumps(with_others).encode()

    bucket.before_put = meanwhile

    def claim() -> int:
        access = BucketAccess(now=lambda: NOON, send=bucket.send, sleep=waits.append, random=lambda: 0.5)
        return claim_in_bucket(ENVIRONMENT, "2026-11-23", 50, 1000, access)

    if is_granted:
        assert claim() == 50
    else:
        with pytest.raises(OSError, match="others keep changing"):
            claim()
    assert waits == pytest.approx([0.05, 0.1, 0.15, 0.2, 0.25])


def test_a_lease_doubles_until_it_costs_two_requests_for_many_commands() -> None:
    bucket, wanted = Bucket(), []

    def claim(day: str, count: int, most: int) -> int:
        wanted.append(count)
        return bucket.claim(day, count, most)

    each = DayBudget(BurstSettings(robot_commands_per_day=10**6, commands_per_day=100_000), claim)
    taken(each, 2250)
    assert wanted == [50, 100, 200, 400, 500, 500, 500]

    taken(each, 1, now_s=NOON_S + 86400)
    assert wanted[-1] == 50, "a new day begins with few commands"


def test_executions_that_end_after_a_few_commands_leave_most_of_the_day_to_others() -> None:
    bucket, settings = Bucket(), BurstSettings()
    for _ in range(500):
        assert taken(DayBudget(settings, bucket.claim), 3) == 3

    assert bucket.body is not None
    assert json.loads(bucket.body)["granted"] <= settings.commands_per_day * 0.05


def test_a_robot_has_a_budget_of_its_own_and_tenants_are_apart() -> None:
    each = budget(Bucket(), robot=5)

    assert taken(each, 9) == 5
    assert taken(each, 9, robot=OTHER) == 5
    with pytest.raises(QuotaExceeded) as told:
        each.take(ROBOT, NOON_S)
    assert told.value.retry_after_ms == pytest.approx(12 * 3600e3)


def test_the_next_day_begins_with_a_whole_budget() -> None:
    each = budget(Bucket(), robot=5, every=5)
    assert taken(each, 9) == 5

    assert taken(each, 9, now_s=NOON_S + 86400) == 5


def test_without_the_bucket_nothing_is_answered_and_it_is_not_asked_for_each_command() -> None:
    bucket = Bucket()
    bucket.down = True
    each = budget(bucket)
    for after_s in (0.0, 1.0, 4.9):
        with pytest.raises(Busy):
            each.take(ROBOT, NOON_S + after_s)
    bucket.down = False
    with pytest.raises(Busy):
        each.take(ROBOT, NOON_S + 4.9)

    each.take(ROBOT, NOON_S + 5.1)


@pytest.mark.parametrize("damaged", [b"", b"[]", b'{"day": 7}', b'{"day": "2027-01-01", "granted": 1}'])
def test_a_budget_that_cannot_be_read_is_no_reason_to_spend(damaged: bytes) -> None:
    bucket = Bucket()
    bucket.body = damaged

    with pytest.raises(Busy):
        budget(bucket).take(ROBOT, NOON_S)
    assert bucket.body == damaged


def test_the_write_is_signed_as_the_aws_sdk_signs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    auth = pytest.importorskip("botocore.auth", reason="the aws extra is not installed")
    from botocore.awsrequest import AWSRequest
    from botocore.credentials import Credentials

    request = signed_request(ENVIRONMENT, NOON, name="burst/budget.json", body=b"{}")
    theirs = AWSRequest(method="PUT", url=request.full_url, data=b"{}")
    theirs.context["payload_signing_enabled"] = True
    if not hasattr(auth, "get_current_datetime"):
        pytest.skip("this botocore reads its clock elsewhere")
    monkeypatch.setattr(auth, "get_current_datetime", lambda *_: NOON.replace(tzinfo=None))
    auth.S3SigV4Auth(Credentials("AKIDEXAMPLE", "secret", "session"), "s3", "ap-northeast-2").add_auth(theirs)

    assert request.get_header("Authorization") == theirs.headers["Authorization"]
