"""What S3 adds to the contract of every store: retries, lost answers, presigned URLs."""

from __future__ import annotations

import hashlib
import urllib.parse
from typing import Any

import pytest
from botocore.exceptions import ClientError, ConnectTimeoutError

from rse_pf.aws.clients import MAX_S, MAX_TRIES, make_client, with_retries
from rse_pf.aws.storage import S3Store, open_bucket
from rse_pf.errors import Archived, Conflict, StoreError


@pytest.fixture
def store(region: str) -> S3Store:
    """An empty bucket."""
    make_client("s3", region).create_bucket(
        Bucket="maps", CreateBucketConfiguration={"LocationConstraint": region}
    )
    return open_bucket("maps", region)


def refusal(code: str, status: int) -> ClientError:
    return ClientError({"Error": {"Code": code}, "ResponseMetadata": {"HTTPStatusCode": status}}, "PutObject")


class Clock:
    """Time that passes only in a call or a sleep."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.tries = 0

    def fail(self, error: Exception, takes_s: float) -> Any:
        def call() -> None:
            self.tries += 1
            self.now_s += takes_s
            raise error

        return call

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


@pytest.mark.parametrize(("takes_s", "tries"), [(0.01, 3), (1.0, 3), (4.5, 2)])
def test_a_failing_service_is_called_at_most_three_times_within_ten_seconds(
    takes_s: float, tries: int
) -> None:
    clock = Clock()
    lost = ConnectTimeoutError(endpoint_url="https://s3")

    with pytest.raises(StoreError, match="does not answer"):
        with_retries(clock.fail(lost, takes_s), clock=lambda: clock.now_s, sleep=clock.sleep)

    assert clock.tries == tries <= MAX_TRIES
    assert clock.now_s <= MAX_S


@pytest.mark.parametrize(
    ("code", "status", "tries"),
    [
        ("InternalError", 500, 3),
        ("SlowDown", 503, 3),
        ("Throttling", 400, 3),
        ("AccessDenied", 403, 1),
        ("ThrottlingException", 400, 3),
        ("RequestLimitExceeded", 400, 3),
        ("TooManyRequestsException", 400, 3),
        ("LimitExceededException", 400, 1),
        ("ConditionalRequestConflict", 409, 3),
        ("OperationAborted", 409, 3),
        ("PreconditionFailed", 412, 1),
    ],
)
def test_only_temporary_errors_are_retried(code: str, status: int, tries: int) -> None:
    clock = Clock()

    with pytest.raises((ClientError, StoreError)):
        with_retries(clock.fail(refusal(code, status), 0.0), clock=lambda: clock.now_s, sleep=clock.sleep)

    assert clock.tries == tries


class Lossy:
    """A bucket's client that loses the answer to the first write, after S3 has done it."""

    def __init__(self, client: Any) -> None:
        self._client = client
        self._lose = True

    def __getattr__(self, name: str) -> Any:
        return getattr(self._client, name)

    def put_object(self, **arguments: Any) -> Any:
        done = self._client.put_object(**arguments)
        if self._lose:
            self._lose = False
            raise ConnectTimeoutError(endpoint_url="https://s3")
        return done


def test_a_swap_whose_answer_was_lost_is_no_conflict(store: S3Store, region: str) -> None:
    lossy = S3Store(Lossy(make_client("s3", region)), "maps")

    lossy.compare_and_swap("head", None, b"mine")

    assert store.get("head") == b"mine"


def test_a_swap_after_another_writers_swap_is_a_conflict(store: S3Store, region: str) -> None:
    client = make_client("s3", region)

    class Overtaken(Lossy):
        def put_object(self, **arguments: Any) -> Any:
            store.put("head", b"theirs")
            return client.put_object(**arguments)

    store.put("head", b"before")
    with pytest.raises(Conflict):
        S3Store(Overtaken(client), "maps").compare_and_swap("head", b"before", b"mine")
    assert store.get("head") == b"theirs"


class Undecided:
    """A bucket's client that answers the first *times* writes with 409, and does nothing."""

    def __init__(self, client: Any, times: int) -> None:
        self._client = client
        self.left = times

    def __getattr__(self, name: str) -> Any:
        return getattr(self._client, name)

    def put_object(self, **arguments: Any) -> Any:
        if self.left:
            self.left -= 1
            raise refusal("ConditionalRequestConflict", 409)
        return self._client.put_object(**arguments)


def test_a_409_of_s3_is_retried_because_nothing_was_stored(store: S3Store, region: str) -> None:
    undecided = Undecided(make_client("s3", region), times=MAX_TRIES - 1)

    S3Store(undecided, "maps").compare_and_swap("head", None, b"mine")

    assert store.get("head") == b"mine"


def test_after_a_409_the_object_that_is_there_decides(store: S3Store, region: str) -> None:
    undecided = S3Store(Undecided(make_client("s3", region), times=1), "maps")
    store.put("head", b"theirs")

    with pytest.raises(Conflict):
        undecided.compare_and_swap("head", None, b"mine")
    store.put("other", b"mine")
    S3Store(Undecided(make_client("s3", region), times=1), "maps").compare_and_swap("other", None, b"mine")


def test_all_pages_of_a_listing_are_read_and_foreign_names_left_out(store: S3Store, region: str) -> None:
    class SmallPages:
        """A client whose listings come in pages of ten."""

        def __init__(self) -> None:
            self.pages = 0

        def list_objects_v2(self, **arguments: Any) -> Any:
            self.pages += 1
            return client.list_objects_v2(**arguments, MaxKeys=10)

    client, small = make_client("s3", region), SmallPages()
    names = [f"maps/{number:04d}" for number in range(33)]
    for name in (*names, "maps/not ours"):
        client.put_object(Bucket="maps", Key=name, Body=b"")

    assert [info.name for info in S3Store(small, "maps").list("maps/")] == names
    assert small.pages == 4


def test_a_presigned_url_fixes_name_length_and_digest(store: S3Store) -> None:
    data = b"keyframe"

    url, headers = store.presigned_put(
        "maps/a", size=len(data), sha256=hashlib.sha256(data).hexdigest(), ttl_s=60
    )

    query = urllib.parse.parse_qs(urllib.parse.urlsplit(url).query)
    signed = query["X-Amz-SignedHeaders"][0].split(";")
    assert set(headers) == {"Content-Length", "x-amz-checksum-sha256"}
    assert {name.lower() for name in headers} <= set(signed), "a header that is not signed may be changed"
    assert query["X-Amz-Algorithm"] == ["AWS4-HMAC-SHA256"]
    assert query["X-Amz-Expires"] == ["60"]
    assert urllib.parse.urlsplit(url).path.endswith("/maps/a")


@pytest.mark.parametrize(
    ("tier", "is_readable"), [("GLACIER_IR", True), ("STANDARD_IA", True), ("GLACIER", False)]
)
def test_an_object_in_an_archive_is_distinguished_from_a_refusal(
    store: S3Store, region: str, tier: str, is_readable: bool
) -> None:
    make_client("s3", region).put_object(Bucket="maps", Key="maps/a", Body=b"map", StorageClass=tier)

    if is_readable:
        assert (store.get("maps/a"), store.get_range("maps/a", 1, 1)) == (b"map", b"a")
        return
    for read in (lambda: store.get("maps/a"), lambda: store.get_range("maps/a", 0, 1)):
        with pytest.raises(Archived, match="'maps/a' is archived") as told:
            read()
        assert "restore-object" in told.value.hint
        assert "policy" not in told.value.hint
