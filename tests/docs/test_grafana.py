"""The Grafana dashboard shows every metric, names no other, and is the one that the sources generate."""

from __future__ import annotations

import json
import re
from pathlib import Path

from prometheus_client.core import CounterMetricFamily

from rse_pf.backend.metrics import GAUGE_HELP
from scripts.grafana import all_metrics, dashboard

FILE = Path(__file__).parents[2] / "docs" / "grafana.json"


def test_the_file_is_the_dashboard_of_todays_metrics() -> None:
    assert json.loads(FILE.read_text(encoding="utf-8")) == dashboard(all_metrics()), "run make docs"


def test_every_metric_has_a_panel_with_what_it_means() -> None:
    panels = {panel["title"]: panel for panel in dashboard(all_metrics())["panels"]}

    assert {*GAUGE_HELP, "requests", "shed", "handshakes", "closed", "bytes", "duration_seconds"} <= {*panels}
    assert "server_up" in panels
    assert all(panel["description"].strip() for panel in panels.values())
    assert panels["queue_ms"]["fieldConfig"]["defaults"]["unit"] == "ms"
    places = [tuple(panel["gridPos"].values()) for panel in panels.values()]
    assert len(set(places)) == len(panels)


def test_every_query_names_a_sample_that_servers_have() -> None:
    metrics = all_metrics()
    known = {sample.name for metric in metrics for sample in metric.samples}
    for panel in dashboard(metrics)["panels"]:
        for target in panel["targets"]:
            assert {*re.findall(r"rse_pf_\w+", target["expr"])} <= known, target["expr"]


def test_what_only_grows_is_shown_as_a_rate_by_its_labels() -> None:
    panels = {panel["title"]: panel for panel in dashboard(all_metrics())["panels"]}

    assert panels["requests"]["targets"][0] == {
        "refId": "A",
        "datasource": {"type": "prometheus", "uid": "${datasource}"},
        "expr": 'sum by (result, service) (rate(rse_pf_requests_total{server=~"$server"}[$__rate_interval]))',
        "legendFormat": "{{result}} {{service}}",
    }
    assert panels["cpu_s"]["targets"][0]["expr"] == 'rate(rse_pf_cpu_s{server=~"$server"}[$__rate_interval])'
    assert len(panels["duration_seconds"]["targets"]) == 3


def test_a_new_metric_gets_a_panel() -> None:
    new = CounterMetricFamily("rse_pf_visits", "visits of nobody", labels=["kind"])
    new.add_metric(["x"], 1)

    panels = dashboard([*all_metrics(), new])["panels"]

    assert panels[-1]["title"] == "visits"
    assert "rse_pf_visits_total" in panels[-1]["targets"][0]["expr"]


def test_the_disks_of_the_platform_are_shown_whatever_server_is_chosen() -> None:
    panels = {panel["title"]: panel for panel in dashboard(all_metrics())["panels"]}

    (target,) = panels["disk_free_bytes"]["targets"]
    assert (target["expr"], target["legendFormat"]) == ("rse_pf_disk_free_bytes", "{{folder}}")
