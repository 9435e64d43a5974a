"""The signed GET of the key set."""

from __future__ import annotations

from datetime import datetime, timezone

import pytest

from lambda_pnp.keys import KeyCache, signed_request
from rse_pf.auth.roster import DenyList, EnrolledRobot, Roster, public_key_of, to_json
from rse_pf.auth.tokens import Claims, SigningKey
from rse_pf.errors import NotFound
from rse_pf.identity import RobotId

ENVIRONMENT = {
    "RSE_PF_KEYS": "artifacts/keys.json", "AWS_REGION": "ap-northeast-2", "AWS_ACCESS_KEY_ID": "AKIDEXAMPLE",
    "AWS_SECRET_ACCESS_KEY": "secret", "AWS_SESSION_TOKEN": "session",
}  # fmt: skip
NOW = datetime(2026, 11, 21, 6, 0, 0, tzinfo=timezone.utc)


def test_the_signature_is_the_one_that_the_aws_sdk_makes(monkeypatch: pytest.MonkeyPatch) -> None:
    auth = pytest.importorskip("botocore.auth", reason="the aws extra is not installed")
    from botocore.awsrequest import AWSRequest
    from botocore.credentials import Credentials

    request = signed_request(ENVIRONMENT, NOW)
    theirs = AWSRequest(method="GET", url=request.full_url)
    signer = auth.S3SigV4Auth(Credentials("AKIDEXAMPLE", "secret", "session"), "s3", "ap-northeast-2")
    module = auth if hasattr(auth, "get_current_datetime") else None
    if module is None:
        pytest.skip("this botocore reads its clock elsewhere")
    monkeypatch.setattr(module, "get_current_datetime", lambda *_: NOW.replace(tzinfo=None))
    signer.add_auth(theirs)

    assert request.get_header("Authorization") == theirs.headers["Authorization"]


class Bucket:
    """A bucket whose object may change, or be away."""

    def __init__(self, *key_ids: str) -> None:
        self.holds(*key_ids)
        self.reads = 0

    def holds(self, *key_ids: str) -> None:
        keys = [SigningKey.from_seed(name.encode() * 32, name).key_set().to_json()[10:-2] for name in key_ids]
        self.text = f'{{"keys": [{", ".join(keys)}]}}' if keys else ""

    def read(self) -> str:
        self.reads += 1
        if not self.text:
            raise OSError("HTTP Error 403: Forbidden")
        return self.text


def test_a_running_function_learns_new_keys_and_forgets_retired_ones() -> None:
    bucket = Bucket("a")
    keys = KeyCache(bucket.read, 60.0)

    assert keys.at(0.0).get("a") is not None
    bucket.holds("b")

    assert keys.at(59.9).get("b") is None, "within the period nobody asks"
    assert bucket.reads == 1
    assert keys.at(60.0).get("b") is not None
    assert keys.at(60.0).get("a") is None


def test_an_unreachable_bucket_keeps_the_keys_and_is_retried_soon(
    capsys: pytest.CaptureFixture[str],
) -> None:
    bucket = Bucket("a")
    keys = KeyCache(bucket.read, 60.0)
    keys.at(0.0)
    bucket.holds()

    assert keys.at(60.0).get("a") is not None
    assert "403" in capsys.readouterr().err
    assert keys.at(64.9).get("a") is not None
    assert bucket.reads == 2
    keys.at(65.0)
    assert bucket.reads == 3
    assert keys.at(86_400.0).get("a") is not None, "as on servers, there is no limit in time"


class Room:
    """A access control store whose objects may be there, missing, or out of reach."""

    def __init__(self) -> None:
        self.objects: dict[str, str] = {}
        self.error: Exception | None = None

    def read(self, name: str) -> str:
        if self.error is not None:
            raise self.error
        if name not in self.objects:
            raise NotFound(f"no {name}")
        return self.objects[name]


CLAIMS = Claims(robot=RobotId("default", "r"), token_id="t", issued_s=0.0, expires_s=900.0, key_id="a")
DISABLED = to_json(DenyList().with_robot("default", "r", 1.0)).decode()


def test_a_robot_that_was_disabled_is_refused_within_a_period() -> None:
    bucket, room = Bucket("a"), Room()
    cache = KeyCache(bucket.read, 30.0, read_control=room.read)
    assert cache.at(0.0).denies(CLAIMS) == ""

    room.objects["deny.json"] = DISABLED

    assert cache.at(29.9).denies(CLAIMS) == ""
    assert cache.at(30.0).denies(CLAIMS) == "disabled"


@pytest.mark.parametrize("harm", [OSError("HTTP Error 403: Forbidden"), NotFound("gone"), None])
def test_a_deny_list_out_of_reach_stays_as_it_was_known(harm: Exception | None) -> None:
    bucket, room = Bucket("a"), Room()
    room.objects["deny.json"] = DISABLED
    cache = KeyCache(bucket.read, 30.0, read_control=room.read)
    cache.at(0.0)
    room.error = harm
    room.objects["deny.json"] = "nonsense"

    assert cache.at(31.0).denies(CLAIMS) == "disabled"
    assert cache.at(31.0).get("a") is not None


def test_every_token_is_refused_while_the_deny_list_was_never_read() -> None:
    room = Room()
    room.error = OSError("HTTP Error 403: Forbidden")

    assert KeyCache(Bucket("a").read, 30.0, read_control=room.read).at(0.0).get("a") is None


def test_an_enrolled_robots_key_is_known() -> None:
    key = SigningKey.of_robot(b"r" * 32)
    robot = EnrolledRobot(robot="r", x=public_key_of(key.public_json()))
    room = Room()
    room.objects["robots.json"] = to_json(Roster(robots=(robot,))).decode()

    assert KeyCache(Bucket("a").read, 30.0, read_control=room.read).at(0.0).robot_of(key.key_id) == robot
