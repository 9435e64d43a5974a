"""The Grafana dashboard shows every metric, names no other, and is the one that the sources generate."""

from __future__ import annotations

import json
from pathlib import Path

from scripts.grafana import all_metrics, dashboard

FILE = Path(__file__).parents[2] / "docs" / "grafana.json"


def test_the_file_is_the_dashboard_of_todays_metrics() -> None:
    assert json.loads(FILE.read_text(encoding="utf-8")) == dashboard(all_metrics()), "run make docs"
