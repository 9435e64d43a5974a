"""An experiment's folder and report: nothing foreign is removed, and a missed bar reads as missed."""

from __future__ import annotations

import json

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.experiments.paper.result_folder import finish_report, fresh_folder, generator_of, policy_of
from rse_pf.experiments.results.markdown import robustness_markdown
from rse_pf.experiments.results.records import Records


def test_an_earlier_run_is_replaced_whole(tmp_path):
    out = tmp_path / "out"
    for part in ("kill", "stop"):
        (out / part).mkdir(parents=True)
        (out / part / "events.jsonl").write_text("")
    for name in ("report.json", "report.md", "robustness.png"):
        (out / name).write_text("old")

    fresh_folder(out, ("robustness.png",))

    assert list(out.iterdir()) == []


def test_what_no_experiment_wrote_is_not_touched(tmp_path):
    (tmp_path / "thesis.tex").write_text("all of it")
    with pytest.raises(UsageError, match="holds other files"):
        fresh_folder(tmp_path, ())
    assert (tmp_path / "thesis.tex").exists()


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(UsageError, match="is a file"):
        fresh_folder(tmp_path / "out", ())


def test_a_report_names_machine_load_and_settings(tmp_path):
    settings = PlatformSettings()

    finish_report(tmp_path, {"experiment": "x"}, settings, [0.1, 0.2, 0.3])

    around = json.loads((tmp_path / "report.json").read_text())["environment"]
    assert around["load_average"] == [0.1, 0.2, 0.3]
    assert len(around["load_average_after"]) == 3
    assert around["settings_digest"] == settings.digest()
    assert "numpy" in around["versions"]


def test_compression_shortens_periods_but_no_threshold():
    full, fast = policy_of(PlatformSettings(), 1.0), policy_of(PlatformSettings(), 30.0)

    assert (fast["period_s"], fast["idle_s"]) == (full["period_s"] / 30, full["idle_s"] / 30)
    assert {name: fast[name] for name in fast if name not in ("period_s", "idle_s")} == {
        name: full[name] for name in full if name not in ("period_s", "idle_s")
    }


def test_a_run_that_did_not_end_has_no_generator():
    with pytest.raises(UsageError, match="generator"):
        generator_of(Records(commands=[], events=[], readings=[]))


def test_a_missed_bar_reads_as_missed():
    counts = {"sent": 10, "answered": 9, "failed": 1, "lost": 0, "twice": 0}
    bars = {
        "gap_s/p99": {"value": 1.5, "bar": "<= 1", "held": False},
        "commands/lost": {"value": 0, "bar": "<= 0", "held": True},
    }
    run = {
        "commands": counts, "failures_by_code": {"busy": 1}, "gap_s": {"p50": 0.4, "p99": 1.5},
        "out_of_rotation_s": None, "replaced_in_s": 3.0, "bars": bars,
    }  # fmt: skip
    around = {
        "load_average": [0], "load_average_after": [0], "cores": 2, "system": "s", "python": "3",
        "versions": {}, "settings_digest": "d",
    }  # fmt: skip

    page = robustness_markdown(
        {"asked": {"robots": 1, "fps": 5.0}, "runs": {"kill": run}, "environment": around}
    )

    assert "| kill | gap_s/p99 | 1.5 | <= 1 | **missed** |" in page
    assert "| kill | commands/lost | 0 | <= 0 | held |" in page
    assert "1 of 2 bars held" in page
    assert "(busy 1)" in page
