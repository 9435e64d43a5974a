"""No check that ends servers depends on what all servers share, and a replacement comes before an end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from fake_data_service import Service, small_settings

from rse_pf.config.resource_names import READY_PATH
from rse_pf.errors import StoreError
from rse_pf.object_store import MemoryStore

Assembly = Any


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


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_servers_outlive_a_bucket_that_fails_and_then_is_silent(tmp_path: Any) -> None:
    pytest.importorskip("moto.server", reason="the infra extra is not installed")
    from benchmarks.cloud.s3_outage import Outage, measure

    report = measure(Outage(servers=2, before_s=5.0, outage_s=36.0, after_s=15.0), tmp_path)

    assert report.ended == []
    assert set(report.poses) == {"cloud"}, "every pose is computed by a server"
    assert {each for each in report.data if each != "201"} <= {"503 store"}
    assert report.alarm_after_s is not None
    assert report.alarm_after_s <= 60
    assert set(report.data_after) == {"201"}


@pytest.mark.slow
@pytest.mark.timeout(180)
def test_the_check_of_the_bucket_would_have_ended_every_server(tmp_path: Any) -> None:
    pytest.importorskip("moto.server", reason="the infra extra is not installed")
    from benchmarks.cloud.s3_outage import Outage, measure

    outage = Outage(servers=2, before_s=5.0, outage_s=24.0, after_s=6.0, data_path="/data/readyz")
    report = measure(outage, tmp_path)

    assert sorted(report.ended) == ["server-0: data", "server-1: data"]
