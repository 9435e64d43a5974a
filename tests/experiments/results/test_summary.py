"""The summary of a run is computed from its raw records alone."""

from __future__ import annotations

import pytest

from rse_pf.extensions.experiments.results.records import CommandRecord
from rse_pf.extensions.experiments.results.summary import (
    longest_outages,
    outage_figures,
)


def answered(number, time_s):
    return CommandRecord(
        id=number, robot="r", planned=time_s - 0.01, sent=time_s - 0.01, answered=time_s, server="a",
        code="ok", round_trip_ms=10.0,
    )  # fmt: skip


def asked_in_vain(number, time_s):
    return CommandRecord(id=number, robot="r", planned=time_s, sent=time_s, answered=None, server="", code="")


def test_a_robot_that_was_never_answered_is_counted():
    commands = [asked_in_vain(1, 1.0), asked_in_vain(2, 7.0)]

    figures = outage_figures(commands, {"r"}, start_s=1.0, end_s=3.0)

    assert figures == {"robots": 1, "p50": 6.0, "p99": 6.0, "max": 6.0}


def test_the_outage_of_a_robot_without_further_answers_ends_with_its_last_command():
    commands = [answered(1, 1.0), answered(2, 1.2), asked_in_vain(3, 1.4), asked_in_vain(4, 8.0)]

    assert longest_outages(commands, {"r"}, start_s=1.3, end_s=3.0)["r"] == pytest.approx(6.8)
