"""Make one page for Prometheus of the metrics of all servers, and the file by which it finds the servers.

Every sample gets the label ``server``.  Of a server that does not answer the page has ``rse_pf_server_up``
alone, with the value 0.  The page also has the free and total space of the platform's disks.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rse_pf.errors import MissingExtra
from rse_pf.local.state import ServerState

__all__ = ["federate_pages", "service_discovery"]

_LOOPBACK = "127.0.0.1"
# Label of every metric with the name of its server.
_LABEL = "server"
# Label of the metrics about disks with the folder on that disk.
_FOLDER = "folder"


def federate_pages(pages: Mapping[str, str | None], disks: Sequence[Mapping[str, Any]] = ()) -> bytes:
    """Return one page in the text format of Prometheus.

    Args:
        pages: Text of the metrics page of each server, by name; None for a server that did not answer.
        disks: One mapping for each file system that the platform writes to, with the keys ``folder``,
            ``free_bytes`` and ``total_bytes``.

    Raises:
        MissingExtra: ``prometheus_client`` is not installed.
    """
    try:
        from prometheus_client import CollectorRegistry, generate_latest
        from prometheus_client.core import GaugeMetricFamily
        from prometheus_client.metrics_core import Metric
        from prometheus_client.parser import text_string_to_metric_families
    except ImportError as error:
        raise MissingExtra("prometheus-client", "backend") from error

    up = GaugeMetricFamily(
        "rse_pf_server_up", "whether the server answered when it was asked for metrics", labels=[_LABEL]
    )
    free = GaugeMetricFamily(
        "rse_pf_disk_free_bytes", "bytes that the platform may still write there", labels=[_FOLDER]
    )
    total = GaugeMetricFamily("rse_pf_disk_total_bytes", "size of the file system", labels=[_FOLDER])
    for disk in disks:
        free.add_metric([disk["folder"]], disk["free_bytes"])
        total.add_metric([disk["folder"]], disk["total_bytes"])
    families: dict[str, Metric] = {}
    for server, page in pages.items():
        up.add_metric([server], float(page is not None))
        for family in text_string_to_metric_families(page or ""):
            merged = families.setdefault(
                family.name, Metric(family.name, family.documentation, family.type, family.unit)
            )
            merged.samples += [
                sample._replace(labels={_LABEL: server, **sample.labels}) for sample in family.samples
            ]

    class Families:
        def collect(self) -> Iterable[Any]:
            return [up, free, total, *families.values()]

    registry = CollectorRegistry()
    registry.register(Families())
    return generate_latest(registry)


def service_discovery(platform: str, servers: Iterable[ServerState]) -> str:
    """Return the JSON text of a file for ``file_sd_configs`` of Prometheus.

    It has one target, the control port on loopback, for each server that has announced its port.
    """
    groups = [
        {
            "targets": [f"{_LOOPBACK}:{server.control_port}"],
            "labels": {"platform": platform, _LABEL: server.name},
        }
        for server in servers
        if server.control_port
    ]
    return json.dumps(groups, indent=2) + "\n"
