"""What Envoy is told: the values that decided between good and bad, and nothing open to others."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import READY_PATH
from rse_pf.local.balancer.envoy_config import (
    CLUSTER,
    DATA_CLUSTER,
    endpoints,
    envoy_config,
)
from rse_pf.scaling.health import HEALTHY_CHECKS, LOCAL_INTERVAL_S, LOCAL_TIMEOUT_S

ENDPOINTS = Path("/somewhere/endpoints.json")
DATA = Path("/somewhere/data-endpoints.json")
ROSBRIDGE = Path("/somewhere/rosbridge-endpoints.json")


def config(**groups: dict[str, Any]) -> dict[str, Any]:
    return envoy_config(
        PlatformSettings().replace(**groups),
        port=0,
        endpoints_file=ENDPOINTS,
        data_endpoints_file=DATA,
        rosbridge_endpoints_file=ROSBRIDGE,
    )


def listener(made: dict[str, Any]) -> dict[str, Any]:
    front, *_ = made["static_resources"]["listeners"]
    return front


def manager(made: dict[str, Any]) -> dict[str, Any]:
    return listener(made)["filter_chains"][0]["filters"][0]["typed_config"]


def cluster(made: dict[str, Any], name: str = CLUSTER) -> dict[str, Any]:
    (only,) = [each for each in made["static_resources"]["clusters"] if each["name"] == name]
    return only


def routes(made: dict[str, Any]) -> list[dict[str, Any]]:
    (host,) = manager(made)["route_config"]["virtual_hosts"]
    return host["routes"]


def only_route(made: dict[str, Any]) -> dict[str, Any]:
    """Return the only one that leads to backend servers, but for the page of health."""
    leading = [each for each in routes(made) if each.get("route", {}).get("cluster") == CLUSTER]
    (route,) = [each for each in leading if each["match"] != {"path": "/healthz"}]
    return route


def test_no_clock_of_the_balancer_ends_an_open_socket() -> None:
    made = config()

    assert manager(made)["stream_idle_timeout"] == "0s"
    assert manager(made)["request_timeout"] == "0s"
    assert only_route(made)["route"]["timeout"] == "0s"
    assert only_route(made)["route"]["idle_timeout"] == "0s"


def test_the_settings_that_decided_between_good_and_bad_are_set() -> None:
    made = config()
    retry = only_route(made)["route"]["retry_policy"]
    (breaker,) = cluster(made)["circuit_breakers"]["thresholds"]

    assert cluster(made)["common_lb_config"]["update_merge_window"] == "0s"
    assert cluster(made)["common_lb_config"]["healthy_panic_threshold"] == {"value": 0}
    assert cluster(made)["ignore_health_on_host_removal"] is True
    assert manager(made)["delayed_close_timeout"] == "0s"
    assert retry["per_try_timeout"] == "0.5s"
    assert retry["host_selection_retry_max_attempts"] == "8"
    assert min(breaker.values()) > 1024
    assert listener(made)["enable_reuse_port"] is False
    assert listener(made)["max_connections_to_accept_per_socket_event"] == 1


def test_health_checks_follow_the_settings() -> None:
    (check,) = cluster(config(health={"unhealthy_checks": 3}))["health_checks"]

    assert check["interval"] == check["no_traffic_interval"] == f"{LOCAL_INTERVAL_S}s"
    assert check["timeout"] == f"{LOCAL_TIMEOUT_S}s"
    assert (check["healthy_threshold"], check["unhealthy_threshold"]) == (HEALTHY_CHECKS, 3)
    assert check["http_health_check"] == {"path": READY_PATH}


def test_large_data_has_a_way_of_its_own_that_is_never_repeated_by_the_balancer() -> None:
    made = config()
    ways = [each for each in routes(made) if each.get("route", {}).get("cluster") == DATA_CLUSTER]
    data = ways[0]

    assert [each["match"] for each in ways] == [{"prefix": "/data/"}, {"prefix": "/localise/"}]
    assert ways[1]["route"] == data["route"]
    assert data["route"]["timeout"] == "0s", "an upload takes as long as it takes"
    assert data["route"]["idle_timeout"] == "30s"
    assert "retry_policy" not in data["route"], "a part may have arrived: only the robot knows"
    assert cluster(made, DATA_CLUSTER)["health_checks"][0]["http_health_check"] == {"path": "/data/readyz"}
    assert endpoints([], DATA_CLUSTER)["resources"][0]["cluster_name"] == DATA_CLUSTER
    files = [
        cluster(made, name)["eds_cluster_config"]["eds_config"]["path_config_source"]["path"]
        for name in (CLUSTER, DATA_CLUSTER)
    ]
    assert files == [str(ENDPOINTS), str(DATA)]
    matches = [each["match"] for each in routes(made)]
    assert matches == [
        {"path": "/ws"}, {"path": "/healthz"}, {"path": "/data/readyz"}, {"prefix": "/data/"},
        {"prefix": "/localise/"},
    ]  # fmt: skip


def test_the_address_of_a_robot_is_that_of_its_connection_whatever_its_headers_claim() -> None:
    made = manager(config())

    assert (made["use_remote_address"], made["xff_num_trusted_hops"]) == (True, 0)


def test_headers_are_bounded_in_number_size_and_time() -> None:
    made = manager(config(session={"hello_timeout_s": 1.5}))

    assert made["request_headers_timeout"] == "1.5s"
    assert made["common_http_protocol_options"]["idle_timeout"] == "1.5s"
    assert made["max_request_headers_kb"] == 8
    assert made["common_http_protocol_options"]["max_headers_count"] <= 100


def test_a_robot_that_takes_nothing_is_ended_by_the_kernel() -> None:
    made = config(session={"ping_interval_s": 2.0, "ping_timeout_s": 1.0})
    options = {(each["level"], each["name"]): each["int_value"] for each in listener(made)["socket_options"]}
    (upstream,) = cluster(made)["upstream_bind_config"]["socket_options"]

    assert options == {
        (socket.SOL_SOCKET, socket.SO_SNDBUF): 262_144,
        (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT): 6000,
    }
    assert (upstream["name"], upstream["int_value"]) == (socket.SO_RCVBUF, 262_144)
