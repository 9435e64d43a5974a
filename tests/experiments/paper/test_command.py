"""A wrong option of an experiment is one line with a hint, before anything starts."""

from __future__ import annotations

import json

import pytest

from rse_pf.cli.main import main
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.paper import command as experiment


def test_a_folder_with_other_files_is_not_touched(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("all of it")

    code = main(["experiment", "latency", "--robots", "1", "--out", str(tmp_path)])

    assert code == 2
    assert "holds other files" in capsys.readouterr().err
    assert (tmp_path / "thesis.tex").read_text() == "all of it"


def test_a_short_form_with_damaged_arguments_is_one_line(tmp_path):
    report = {"experiment": "map", "rerun": {"arguments": ["--frmes", "7"], "slack": 1.5, "bars": {}}}
    (tmp_path / "report.json").write_text(json.dumps(report))

    with pytest.raises(UsageError, match="the short form in the report is damaged"):
        experiment._rerun(tmp_path, PlatformSettings())


def test_a_figure_that_a_short_run_misses_is_named_and_the_verb_fails(tmp_path, monkeypatch, capsys):
    plan = {"arguments": ["--robots", "2"], "slack": 1.5, "bars": {"ate_cm": "<= 1", "lost_frames": "<= 0"}}
    report = {"experiment": "map", "ate_cm": [0.9], "lost_frames": [0], "rerun": plan}
    (tmp_path / "report.json").write_text(json.dumps(report))
    ran = []

    def run_short(args, settings):
        ran.append((args.kind, args.robots))
        args.out.mkdir()
        (args.out / "report.json").write_text(json.dumps({"ate_cm": [1.2, 1.7], "lost_frames": [0, 0]}))
        return 0

    monkeypatch.setattr(experiment, "perform", run_short)

    assert experiment._rerun(tmp_path, PlatformSettings()) == 1
    told = capsys.readouterr().out
    assert ran == [("map", 2)]
    assert "MISSED   ate_cm  1.7 now, must be <= 1.5; 0.9 in the report" in told
    assert "reached  lost_frames" in told
    assert "1 figures of the reports are not reached" in told
