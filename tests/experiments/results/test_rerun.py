"""The short form in a report: which of its figures another run reaches, with the slack of the report."""

from __future__ import annotations

from typing import Any

from rse_pf.extensions.experiments.results.rerun import RERUN, rerun_figures, rerun_plan

WIFI = "wifi/first_answer_after_heal_s/p99"


def report(first_answer_s: float | None, lost: int = 0, **plan: Any) -> dict[str, Any]:
    run = {"commands": {"lost": lost}, "first_answer_after_heal_s": {"p99": first_answer_s}}
    bars = {WIFI: (2.0, "<="), "wifi/commands/lost": (0.0, "<=")}
    made = rerun_plan(["--robots", "20", "--only", "wifi"], bars)
    return {"experiment": "robustness", "runs": {"wifi": run}, RERUN: {**made, **plan}}


def missed(shipped: dict[str, Any], short: dict[str, Any]) -> list[str]:
    return [figure.name for figure in rerun_figures(shipped, short) if not figure.is_reached]


def test_a_slower_machine_reaches_the_figures_with_slack_and_slower_code_does_not():
    shipped = report(1.381)

    assert missed(shipped, report(2.9)) == []
    assert missed(shipped, report(7.2)) == [WIFI]


def test_a_missed_figure_is_named_with_what_it_must_be_and_what_was_shipped():
    (line, _) = map(str, rerun_figures(report(1.381), report(7.2)))

    assert line == f"MISSED   {WIFI}  7.2 now, must be <= 3; 1.381 in the report"


def test_slack_allows_no_lost_command_and_no_missing_figure():
    assert missed(report(1.0), report(1.0, lost=1)) == ["wifi/commands/lost"]
    assert missed(report(1.0), report(None)) == [WIFI]
    assert missed(report(1.0), {"runs": {}}) == [WIFI, "wifi/commands/lost"]
