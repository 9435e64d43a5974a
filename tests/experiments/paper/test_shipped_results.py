"""The results in the documentation name their commit, agree with their records, and can be run again."""

from __future__ import annotations

from pathlib import Path

import pytest

from rse_pf.extensions.experiments.paper import command as experiment
from rse_pf.extensions.experiments.paper.verify import read_report, report_folders, verify
from rse_pf.extensions.experiments.results.rerun import rerun_arguments, rerun_figures

RESULTS = Path(__file__).resolve().parents[3] / "docs" / "results"
FOLDERS = report_folders(RESULTS)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_every_figure_that_is_shipped_agrees_with_its_records(folder: Path):
    assert [check.what for check in verify(folder) if check.agrees is False] == []


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_report_reaches_the_figures_of_its_own_short_form(folder: Path):
    report = read_report(folder)

    assert experiment._parse_short_form(rerun_arguments(report)).kind == report["experiment"]
    assert [figure.name for figure in rerun_figures(report, report) if not figure.is_reached] == []


def test_the_short_form_of_robustness_cuts_the_wifi_for_its_full_time():
    report = read_report(RESULTS / "robustness")

    assert "wifi/first_answer_after_heal_s/p99" in report["rerun"]["bars"]
    assert "--speed" not in report["rerun"]["arguments"]
