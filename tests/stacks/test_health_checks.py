"""No check that ends servers depends on what all servers share, and a replacement comes before an end."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import client_sdk
from rse_pf.auth.tokens import SigningKey
from rse_pf.aws.clients import make_client
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import READY_PATH, ROSBRIDGE_PORT
from rse_pf.errors import StoreError
from rse_pf.pnp.problems import make_problem
from rse_pf.scaling.health import CLOUD_TIMEOUT_S, cloud_checks
from rse_pf.storage.object_store import MemoryStore, digest_of
from tests.kit.fake_data_service import Service, small_settings
from tests.kit.fake_s3 import PlayedS3

Assembly = Any
BUCKET = "maps"
KEY = SigningKey.from_seed(b"outage of the bucket, 32 letters", "outage")
PATIENT_S = 60.0
SETTINGS = PlatformSettings.from_dict(
    {
        "serving": {"port": 0, "control_port": 0, "workers": 1},
        "data": {"port": 0},
        "live": {"warm_standby": False},
    }
)


class Shared(MemoryStore):
    """A bucket that does not answer, and counts who asks."""

    def __init__(self) -> None:
        super().__init__()
        self.asked: list[str] = []

    def _refuse(self, name: str) -> Callable[..., Any]:
        def call(*_: Any, **__: Any) -> Any:
            self.asked.append(name)
            raise StoreError("S3 does not answer")

        return call

    def __getattribute__(self, name: str) -> Any:
        if name in ("get", "get_range", "put", "put_pieces", "head", "list", "folders", "delete"):
            return self._refuse(name)
        return super().__getattribute__(name)


def group_of(assembly: Assembly) -> dict[str, Any]:
    """Return the group of the backend servers."""
    groups = assembly.all("AWS::AutoScaling::AutoScalingGroup")
    return next(dict(each) for each in groups if each["AutoScalingGroupName"] == "rse-pf")


def checks_that_end_servers(assembly: Assembly) -> list[tuple[str, str]]:
    """Return port and path of the checks of every target group whose health is the group's."""
    resources = assembly.templates["RsePf-Backend"]["Resources"]
    group = group_of(assembly)
    assert "ELB" in str(group.get("HealthCheckType", group.get("HealthCheckTypes")))
    found = [resources[each["Ref"]]["Properties"] for each in group["TargetGroupARNs"]]
    return [(each["HealthCheckPort"], each["HealthCheckPath"]) for each in found]


def test_no_check_that_ends_servers_asks_the_bucket(assembly: Assembly) -> None:
    data, serving = assembly.settings.data, assembly.settings.serving
    checks = dict(checks_that_end_servers(assembly))
    assert checks.pop(str(ROSBRIDGE_PORT), None) == ("/healthz" if serving.rosbridge else None)
    store = Shared()

    answer = Service(small_settings(), store).ask("GET", checks[str(data.port)], token="")

    assert answer.status == 200
    assert store.asked == []
    assert checks == {str(serving.control_port): READY_PATH, str(data.port): checks[str(data.port)]}


def test_the_page_that_does_ask_the_bucket_would_be_found() -> None:
    store = Shared()

    assert Service(small_settings(), store).ask("GET", "/data/readyz", token="").status == 503
    assert store.asked == ["head"]


def test_a_replacement_is_ready_before_an_unhealthy_server_ends(assembly: Assembly) -> None:
    policy = group_of(assembly)["InstanceMaintenancePolicy"]

    assert policy == {"MinHealthyPercentage": 100, "MaxHealthyPercentage": 110}


@contextlib.contextmanager
def server_on_a_bucket(home: Path) -> Iterator[dict[str, int]]:
    """Run both processes of one server; yield ``port``, ``control_port`` and ``data_port``."""
    settings = home / "settings.json"
    settings.write_text(json.dumps({"context": {"rse-pf": SETTINGS.to_dict()}}))
    (home / "keys.json").write_text(KEY.key_set().to_json())
    announced = {}
    with contextlib.ExitStack() as stack:
        for verb in ("serve", "data"):
            announce, log = home / f"{verb}.json", home / f"{verb}.log"
            command = [
                sys.executable,
                "-m",
                "rse_pf.cli.main",
                verb,
                "--settings",
                str(settings),
                "--keys",
                str(home / "keys.json"),
                "--store",
                f"s3:{BUCKET}",
                "--announce",
                str(announce),
            ]
            with log.open("wb") as errors:
                process = stack.enter_context(subprocess.Popen(command, stderr=errors))
            stack.callback(process.terminate)
            end_s = time.monotonic() + PATIENT_S
            while not announce.exists():
                assert process.poll() is None, log.read_text()
                assert time.monotonic() < end_s, log.read_text()
                os.sched_yield()
            announced[verb] = json.loads(announce.read_text())
        yield {**announced["serve"], "data_port": announced["data"]["port"]}


def status_of(request: str | urllib.request.Request, timeout_s: float = CLOUD_TIMEOUT_S) -> str:
    """Return the status and, of an error, the code in its JSON; ``none`` without any answer."""
    try:
        with urllib.request.urlopen(request, timeout=timeout_s) as answer:
            return str(answer.status)
    except urllib.error.HTTPError as error:
        with error, contextlib.suppress(ValueError, KeyError):
            return f"{error.code} {json.loads(error.read())['code']}"
        return f"{error.code}"
    except OSError:
        return "none"


def token() -> str:
    return KEY.issue("robot-1", now=time.time(), token_id="t", settings=SETTINGS.auth)


def store(ports: dict[str, int], data: bytes) -> str:
    """Store an object as a robot that does not try again; return what came of it."""
    url = f"http://127.0.0.1:{ports['data_port']}/data/v1/objects/{digest_of(data)}"
    headers = {"Authorization": f"Bearer {token()}"}
    return status_of(urllib.request.Request(url, data=data, method="PUT", headers=headers), PATIENT_S)


async def source_of_a_pose(ports: dict[str, int]) -> str:
    """Return who computed a pose that a robot asked for."""
    problem = make_problem(seed=1)
    url = f"ws://127.0.0.1:{ports['port']}/ws"
    async with client_sdk.connect(url, token=token()) as robot:
        frame = problem.points_world, problem.pixels, problem.camera
        return (await robot.solve_pnp(*frame, deadline_s=PATIENT_S)).source


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_a_server_outlives_a_bucket_that_fails_and_then_is_silent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("moto.server", reason="run make setup")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    with PlayedS3() as s3:
        monkeypatch.setenv("AWS_ENDPOINT_URL_S3", s3.url)
        where = {"LocationConstraint": SETTINGS.cloud.region}
        make_client("s3", SETTINGS.cloud.region).create_bucket(Bucket=BUCKET, CreateBucketConfiguration=where)
        with server_on_a_bucket(tmp_path) as ports:
            at = {"robots": ports["control_port"], "data": ports["data_port"]}
            checks = {
                name: f"http://127.0.0.1:{at[name]}{path}"
                for name, (_, path) in cloud_checks(SETTINGS).items()
            }
            assert store(ports, b"well") == "201"
            for mood in ("unavailable", "silent"):
                s3.mood = mood
                assert store(ports, mood.encode()) == "503 store"
                assert {name: status_of(url) for name, url in checks.items()} == {
                    "robots": "200",
                    "data": "200",
                }
                assert asyncio.run(source_of_a_pose(ports)) == "cloud"
                asks_the_bucket = f"http://127.0.0.1:{ports['data_port']}/data/readyz"
                assert status_of(asks_the_bucket) != "200", "this check would have ended every server"
            s3.mood = "well"
            end_s = time.monotonic() + PATIENT_S
            while store(ports, b"well again") != "201":
                assert time.monotonic() < end_s
