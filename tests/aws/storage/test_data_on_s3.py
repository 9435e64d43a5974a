"""The data service on S3: direct transfers, and a failing S3 that loses nothing."""

from __future__ import annotations

import contextlib
import random
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from client_sdk.transfer.data_client import DataClient, DataOptions
from rse_pf.aws import clients
from rse_pf.aws.clients import make_client
from rse_pf.aws.storage import S3Store, open_bucket
from rse_pf.errors import StoreRefused
from rse_pf.identity import RobotId, object_name
from rse_pf.storage.object_store import digest_of
from tests.kit.fake_data_service import HttpServer, Service, small_settings

BUCKET = "objects"
FAILING_SHARE = 0.3
UPLOADS = 24
LARGE = random.Random(5).randbytes(700_000)


@pytest.fixture
def s3_server(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """An emulated S3 on a port of this machine, which boto3 calls instead of AWS."""
    server_of = pytest.importorskip("moto.server", reason="run make setup")
    server = server_of.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL_S3", f"http://{host}:{port}")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    yield f"http://{host}:{port}"
    server.stop()


def bucket_in(region: str) -> S3Store:
    create_bucket(make_client("s3", region), region)
    return open_bucket(BUCKET, region)


def create_bucket(client: Any, region: str) -> None:
    client.create_bucket(Bucket=BUCKET, CreateBucketConfiguration={"LocationConstraint": region})


def client_of(server: HttpServer, service: Service, **options: Any) -> DataClient:
    chosen = DataOptions(first_pause_s=0.01, max_pause_s=0.05, random=random.Random(2), **options)
    return DataClient(server.url, service.token, chosen)


def test_large_objects_travel_directly_between_robot_and_bucket(s3_server: str) -> None:
    told: list[int] = []

    with contextlib.ExitStack() as stack:
        client = stack.enter_context(contextlib.closing(make_client("s3", "ap-northeast-2")))
        create_bucket(client, "ap-northeast-2")
        store = S3Store(client, BUCKET)
        service = Service(small_settings(max_object_bytes=1_000_000, quota_bytes=2_000_000), store)
        server = stack.enter_context(HttpServer(service))
        robot = stack.enter_context(contextlib.closing(client_of(server, service)))
        digest = robot.upload(LARGE, lambda done, size: told.append(done))

        assert store.get(object_name(RobotId("default", "robot-1"), digest)) == LARGE
        assert robot.download(digest) == LARGE
        assert list(store.list("uploads/")) == []
    assert told[-1] == len(LARGE)
    assert sum(line["received_bytes"] for line in service.lines) < 1000, "the service received the object"
    assert max(line["sent_bytes"] for line in service.lines) < 2000


class Body:
    """What a response of botocore reads its body from."""

    def __init__(self, code: str = "InternalError", *, is_empty: bool = False) -> None:
        self._text = "" if is_empty else f"<Error><Code>{code}</Code><Message>no</Message></Error>"

    def stream(self, *_: Any, **__: Any) -> Iterator[bytes]:
        yield self._text.encode()


class WithoutPresigning:
    """A store that presigns no URLs, so that every byte goes through the service."""

    def __init__(self, store: S3Store) -> None:
        self._store = store

    def __getattr__(self, name: str) -> Any:
        if name.startswith("presigned"):
            raise AttributeError(name)
        return getattr(self._store, name)


@pytest.mark.parametrize(
    ("tries", "largest"), [(1, 3000), pytest.param(clients.MAX_TRIES, 300_000, marks=pytest.mark.slow)]
)
def test_an_s3_that_fails_three_times_in_ten_loses_nothing_acknowledged(
    region: str, monkeypatch: pytest.MonkeyPatch, tries: int, largest: int
) -> None:
    """Without retries of the service every failure reaches the robot; with them, few do."""
    from botocore.awsrequest import AWSResponse

    monkeypatch.setattr(clients, "FIRST_PAUSE_S", 0.001)
    monkeypatch.setattr(clients, "MAX_TRIES", tries)
    chance, lock = random.Random(11), threading.Lock()
    asked = failed = 0

    def fails(share: float) -> bool:
        nonlocal failed
        with lock:
            unlucky = chance.random() < share
            failed += unlucky
            return unlucky

    def refuse(**_: Any) -> tuple[Any, dict[str, Any]] | None:
        """Nothing is done."""
        nonlocal asked
        asked += 1
        if not fails(FAILING_SHARE / 2):
            return None
        told = {"Error": {"Code": "InternalError"}, "ResponseMetadata": {"HTTPStatusCode": 500}}
        return AWSResponse("", 500, {}, None), told

    def lose_the_answer(request: Any, **_: Any) -> AWSResponse | None:
        """The emulator does what it was asked, too."""
        if not fails(FAILING_SHARE / 2 / (1 - FAILING_SHARE / 2)):
            return None
        return AWSResponse(request.url, 500, {"content-type": "application/xml"}, Body())

    plain = bucket_in(region)  # its client does not fail
    failing = make_client("s3", region)
    failing.meta.events.register_first("before-call.s3", refuse)
    failing.meta.events.register_first("before-send.s3", lose_the_answer)
    settings = small_settings(part_bytes=65536, max_object_bytes=1_000_000, quota_bytes=100_000_000)
    service = Service(settings, WithoutPresigning(S3Store(failing, BUCKET)))
    contents = [random.Random(number).randbytes(3000) for number in range(UPLOADS)] + [LARGE[:largest]]

    with HttpServer(service) as server, contextlib.closing(client_of(server, service)) as robot:
        acknowledged = [robot.upload(content) for content in contents]

    assert failed > 0.2 * asked > 10
    assert acknowledged == [digest_of(content) for content in contents]
    refused = sum(line["status"] >= 500 for line in service.lines)
    assert refused > UPLOADS / 4 or tries > 1, "no failure reached the robot"
    for digest, content in zip(acknowledged, contents, strict=True):
        assert plain.get(object_name(RobotId("default", "robot-1"), digest)) == content
    names = {object_name(RobotId("default", "robot-1"), digest) for digest in acknowledged}
    assert {info.name for info in plain.list("objects/")} == names, "a partial object is left"


@pytest.mark.parametrize(
    ("code", "status", "hint"),
    [
        ("NoSuchBucket", 404, "data.store"),
        ("RequestTimeTooSkewed", 403, "clock"),
        ("ExpiredToken", 400, "credentials"),
        ("InvalidAccessKeyId", 403, "credentials"),
        ("AccessDenied", 403, "policy"),
    ],
)
def test_a_refusal_of_s3_reaches_the_robot_at_once_with_the_action_that_helps(
    region: str, code: str, status: int, hint: str
) -> None:
    from botocore.awsrequest import AWSResponse

    def refuse(request: Any, **_: Any) -> AWSResponse:
        """As S3, whose answer to HEAD has no body."""
        body = Body(code, is_empty=request.method == "HEAD")
        return AWSResponse(request.url, status, {"content-type": "application/xml"}, body)

    bucket_in(region)
    refusing = make_client("s3", region)
    refusing.meta.events.register_first("before-send.s3", refuse)
    service = Service(small_settings(), WithoutPresigning(S3Store(refusing, BUCKET)))
    pauses: list[float] = []

    with (
        HttpServer(service) as server,
        contextlib.closing(client_of(server, service, sleep=pauses.append)) as robot,
    ):
        for ask in (lambda: robot.download("0" * 64), lambda: robot.upload(b"small")):
            with pytest.raises(StoreRefused) as refused:
                ask()
            assert hint in refused.value.hint
            assert (code in refused.value.message) or code == "NoSuchBucket"

    assert pauses == []
