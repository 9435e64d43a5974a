"""The metrics of all servers as one page, and the file for the service discovery of Prometheus."""

from __future__ import annotations

import json

from prometheus_client.parser import text_string_to_metric_families

from rse_pf.local.control.federation import federate_pages, service_discovery
from rse_pf.local.processes import ProcessMark
from rse_pf.local.state import ServerState

PAGE = """# HELP rse_pf_requests_total final answers to commands
# TYPE rse_pf_requests_total counter
rse_pf_requests_total{{service="pnp",result="ok"}} {n}
# HELP rse_pf_robots robots that are connected
# TYPE rse_pf_robots gauge
rse_pf_robots {n}
# HELP rse_pf_duration_seconds arrival to answer
# TYPE rse_pf_duration_seconds histogram
rse_pf_duration_seconds_bucket{{service="pnp",le="1.0"}} {n}
rse_pf_duration_seconds_bucket{{service="pnp",le="+Inf"}} {n}
rse_pf_duration_seconds_count{{service="pnp"}} {n}
rse_pf_duration_seconds_sum{{service="pnp"}} 0.5
"""


def test_every_sample_names_its_server_and_every_family_stands_once() -> None:
    text = federate_pages({"server-1": PAGE.format(n=3), "server-2": PAGE.format(n=4)}).decode()

    families = {family.name: family for family in text_string_to_metric_families(text)}
    robots = {s.labels["server"]: s.value for s in families["rse_pf_robots"].samples}
    assert robots == {"server-1": 3.0, "server-2": 4.0}
    requests = {
        (s.labels["server"], s.labels["service"], s.labels["result"]): s.value
        for s in families["rse_pf_requests"].samples
    }
    assert requests == {("server-1", "pnp", "ok"): 3.0, ("server-2", "pnp", "ok"): 4.0}
    buckets = [s for s in families["rse_pf_duration_seconds"].samples if s.name.endswith("_bucket")]
    assert len(buckets) == 4
    assert families["rse_pf_duration_seconds"].type == "histogram"
    helps = [line for line in text.splitlines() if line.startswith("# HELP")]
    assert len(helps) == len(set(helps)) == len(families)
    assert all(len(line.split()) >= 6 for line in helps)


def test_the_file_for_discovery_lists_the_servers_that_are_ready() -> None:
    mark = ProcessMark(pid=1, began="1@boot")
    servers = [
        ServerState(name="server-1", process=mark, port=1000, control_port=1001),
        ServerState(name="server-2", process=mark),
    ]

    assert json.loads(service_discovery("lab", servers)) == [
        {"targets": ["127.0.0.1:1001"], "labels": {"platform": "lab", "server": "server-1"}}
    ]
