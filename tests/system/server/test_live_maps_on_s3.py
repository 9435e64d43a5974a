"""A live map whose lease, log and snapshots lie in S3: two servers, and the owner's one dies."""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from server.live_map.test_served import keyframe

import client_sdk
from rse_pf.aws.clients import make_client
from rse_pf.aws.storage import open_bucket
from rse_pf.config import PlatformSettings
from rse_pf.server.live_map.lease import decode_lease, lease_name
from tests.kit.guarded_server import KEY, GuardedServer

pytestmark = [pytest.mark.slow, pytest.mark.system]

BUCKET, WAIT_S = "maps", 60.0
REGION = PlatformSettings().cloud.region


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """An emulated bucket on a port of this machine."""
    server_of = pytest.importorskip("moto.server", reason="run make setup")
    server = server_of.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    monkeypatch.setenv("AWS_ENDPOINT_URL_S3", f"http://{host}:{port}")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    make_client("s3", REGION).create_bucket(
        Bucket=BUCKET, CreateBucketConfiguration={"LocationConstraint": REGION}
    )
    yield BUCKET
    server.stop()


def robot(server: GuardedServer, name: str) -> client_sdk.Robot:
    token = KEY.issue(name, now=time.time(), token_id=name, settings=server.settings.auth)
    return client_sdk.connect(server.url, token=token, codec="bin", random=random.Random(name))


def test_a_live_map_in_s3_goes_on_when_its_owners_server_dies(bucket: str, tmp_path: Path) -> None:
    groups = {"data": {"store": f"s3:{bucket}"}, "live": {"lease_s": 3.0}}
    for name in ("a", "b"):
        (tmp_path / name).mkdir()

    async def test(first: GuardedServer, second: GuardedServer) -> None:
        async with robot(second, "second") as there, robot(first, "first") as here:
            for number in range(3):
                answer = await here.call("live-keyframe", keyframe(number), deadline_s=WAIT_S)
                assert answer.reply["number"] == number + 1
            assert (await there.call("live-keyframe", keyframe(0), deadline_s=WAIT_S)).reply["number"] == 1
            before = decode_lease("lease", open_bucket(bucket, REGION).get(lease_name("default", "m")))
            first.stop()
            assert (await there.call("live-keyframe", keyframe(1), deadline_s=WAIT_S)).reply["number"] == 2
            shown = (await there.call("live-show", {"map": "m"}, deadline_s=WAIT_S)).reply
            kept = {each["robot"]: each["keyframes"] for each in shown["robots"]}
            assert (kept, shown["epoch"] > before.epoch) == ({"first": 3, "second": 2}, True)

    with (
        GuardedServer(tmp_path / "a", workers=1, **groups) as first,
        GuardedServer(tmp_path / "b", workers=1, **groups) as second,
    ):
        asyncio.run(asyncio.wait_for(test(first, second), 3 * WAIT_S))
