"""Write ``docs/grafana.json``, a Grafana dashboard with a panel for each metric that servers have.

The list of metrics is the page that a server gives to Prometheus, with the labels that the control plane
adds; nothing is listed by hand.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from prometheus_client.metrics_core import Metric
from prometheus_client.parser import text_string_to_metric_families

from rse_pf.local.control.federation import federate_pages
from rse_pf.server.metrics import GAUGE_HELP, Metrics, merge, render

__all__ = ["all_metrics", "dashboard", "main"]

_COLUMNS = 3  # number of panels in a row of the dashboard
_WIDTH = 8  # width of a panel, in the 24 columns of Grafana's grid
_HEIGHT = 7  # height of a panel, in rows of Grafana's grid
# Order of the panels by type of the metric.
_ORDER = {"histogram": 0, "counter": 1, "gauge": 2}
# Unit of a panel in Grafana by the ending of the metric's name.
_UNITS = {"_seconds": "s", "_s": "s", "_ms": "ms", "_bytes": "bytes"}
# Selector of the servers that the user chose in the dashboard.
_HERE = '{server=~"$server"}'
_QUANTILES = (0.5, 0.95, 0.99)  # quantiles that the panel of a histogram shows


def all_metrics() -> list[Metric]:
    """Return the metrics of a platform with one server, histograms and counters before gauges."""
    worker = Metrics()
    worker.count_answer("pnp", "ok", 0.01, "default", 0.01)
    for counter in (worker.shed, worker.handshakes, worker.closed):
        counter["example"] += 1
    worker.gauges.update(dict.fromkeys(GAUGE_HELP, 0.0))
    disk = {"folder": "state", "free_bytes": 0, "total_bytes": 0}
    page = federate_pages({"server-1": render(merge([worker.snapshot()])).decode("utf-8")}, [disk])
    families = text_string_to_metric_families(page.decode("utf-8"))
    return sorted(families, key=lambda each: (_ORDER[each.type], each.name))


def dashboard(metrics: Sequence[Metric]) -> dict[str, Any]:
    """Return the dashboard: a panel for each metric, and variables for the data source and the servers."""
    source = {"type": "prometheus", "uid": "${datasource}"}
    panels = []
    for number, metric in enumerate(metrics):
        row, column = divmod(number, _COLUMNS)
        queries, unit = _queries(metric)
        panels.append(
            {
                "id": number + 1,
                "type": "timeseries",
                "title": metric.name.removeprefix("rse_pf_"),
                "description": metric.documentation,
                "datasource": source,
                "gridPos": {"x": _WIDTH * column, "y": _HEIGHT * row, "w": _WIDTH, "h": _HEIGHT},
                "fieldConfig": {"defaults": {"unit": unit, "min": 0}, "overrides": []},
                "targets": [
                    {
                        "refId": chr(ord("A") + place),
                        "datasource": source,
                        "expr": text,
                        "legendFormat": legend,
                    }
                    for place, (text, legend) in enumerate(queries)
                ],
            }
        )
    servers = {
        "name": "server", "type": "query", "label": "server", "datasource": source, "refresh": 2,
        "query": "label_values(rse_pf_ready, server)", "multi": True, "includeAll": True, "allValue": ".*",
        "current": {"text": "All", "value": "$__all"},
    }  # fmt: skip
    return {
        "uid": "rse-pf",
        "title": "RSE-PF",
        "tags": ["rse-pf"],
        "schemaVersion": 39,
        "refresh": "10s",
        "time": {"from": "now-30m", "to": "now"},
        "templating": {
            "list": [
                {"name": "datasource", "type": "datasource", "label": "Prometheus", "query": "prometheus"},
                servers,
            ]
        },
        "panels": panels,
    }


def main() -> None:
    """Write ``docs/grafana.json``."""
    text = json.dumps(dashboard(all_metrics()), indent=1) + "\n"
    (Path(__file__).parents[1] / "docs" / "grafana.json").write_text(text, encoding="utf-8")


def _queries(metric: Metric) -> tuple[list[tuple[str, str]], str]:
    """Return the expressions of a panel with their legends, and its unit in Grafana's words."""
    if metric.type == "histogram":
        rate = f"sum by (le) (rate({metric.name}_bucket{_HERE}[$__rate_interval]))"
        return [(f"histogram_quantile({q}, {rate})", f"p{100 * q:g}") for q in _QUANTILES], _unit(metric.name)
    labels = _labels(metric) or ["server"]
    by, legend = ", ".join(labels), " ".join(f"{{{{{label}}}}}" for label in labels)
    if metric.type == "counter":
        unit = "Bps" if metric.name.endswith("_bytes") else "ops"
        return [(f"sum by ({by}) (rate({metric.name}_total{_HERE}[$__rate_interval]))", legend)], unit
    if "since the start" in metric.documentation or "since its start" in metric.documentation:
        # A counter only grows, so its rate is shown; processor seconds per second are a share.
        unit = "percentunit" if metric.name.endswith("_s") else "ops"
        return [(f"rate({metric.name}{_HERE}[$__rate_interval])", legend)], unit
    # A metric without the label "server" is one of the platform.
    here = _HERE if any("server" in sample.labels for sample in metric.samples) else ""
    return [(f"{metric.name}{here}", legend)], _unit(metric.name)


def _labels(metric: Metric) -> list[str]:
    """Return the labels of a metric except for that of the server."""
    labels: Iterable[str] = {label for sample in metric.samples for label in sample.labels}
    return sorted(set(labels) - {"server", "le"})


def _unit(name: str) -> str:
    return next((unit for ending, unit in _UNITS.items() if name.endswith(ending)), "short")


if __name__ == "__main__":
    main()
