"""The estimate from load to a serving server: its table of delays, and its figures from the records."""

from __future__ import annotations

from pathlib import Path

import pytest

from rse_pf.experiments.paper.elasticity_as_cloud import as_cloud_figures, as_cloud_page
from rse_pf.experiments.results.records import Records
from rse_pf.scaling.cloud_delays import DESIGNS


def test_every_delay_has_a_range_and_a_source() -> None:
    delays = [each for design in DESIGNS.values() for each in (design.metrics, *design.launch)]

    assert all(0 <= each.low_s <= each.high_s for each in delays)
    assert all(each.source and each.step for each in delays)


def test_the_new_design_leaves_time_for_the_alarm_within_75_seconds() -> None:
    old, new = DESIGNS["0.1.0"].delays, DESIGNS["now"].delays

    assert new.metrics_s + new.launch_s + 30 <= 75, "three samples of 10 s"
    assert 180 <= old.metrics_s + old.launch_s + 120 <= 300, "two samples of 60 s"


def events(**times_s: float) -> Records:
    found = [
        {"time": 0.0, "action": "experiment", "kind": "elasticity-as-cloud", "design": "now", "speed": 10.0,
         "begins_at": 0.5},
        {"time": 1.0, "action": "server-healthy", "server": "server-1"},
    ]  # fmt: skip
    found += [{"time": at, "action": name.replace("_", "-")} for name, at in times_s.items()]
    found += [{"time": at, "action": "robot-joined", "robot": f"robot-{at}"} for at in (2.0, 2.5)]
    return Records(folder=Path("none"), commands=[], samples=[], events=sorted(found, key=_time))


def _time(event: dict[str, object]) -> float:
    return float(str(event["time"]))


def test_times_count_from_the_load_and_in_seconds_of_the_cloud() -> None:
    figures = as_cloud_figures(events(grow=5.0, server_healthy=8.5))

    assert (figures["decided_s"], figures["serving_s"]) == (30.0, 65.0)


def test_a_server_that_never_served_has_no_time() -> None:
    figures = as_cloud_figures(events(grow=5.0))

    assert (figures["decided_s"], figures["serving_s"]) == (30.0, None)


@pytest.mark.parametrize("served", [True, False])
def test_the_page_states_that_it_is_an_estimate(served: bool) -> None:
    run = as_cloud_figures(events(grow=5.0, server_healthy=8.5) if served else events(grow=5.0))
    about = {
        "load_average": [0], "load_average_after": [0], "cores": 2, "system": "Linux", "python": "3.11",
        "versions": {}, "settings_digest": "0",
    }  # fmt: skip
    page = as_cloud_page(
        {
            "asked": {"robots": 100, "fps": 5.0, "speed": 10.0}, "size": 0.1, "runs": {"now-1": run},
            "delays": {"now": [{"step": "s", "low_s": 1.0, "high_s": 2.0, "source": "x"}]},
            "generator": {}, "environment": about,
        }
    )  # fmt: skip

    assert "**estimate**" in page
    assert ("now: 65 s from load to serving" in page) == served
