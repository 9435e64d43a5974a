"""The folder of results: other files are never removed, and a report names machine and settings."""

from __future__ import annotations

import json

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.experiments.results.result_folder import finish_report, fresh_folder


def test_all_results_of_an_earlier_run_are_removed(tmp_path):
    out = tmp_path / "out"
    for part in ("kill", "stop"):
        (out / part).mkdir(parents=True)
        (out / part / "events.jsonl").write_text("")
    for name in ("report.json", "report.md", "robustness.png"):
        (out / name).write_text("old")

    fresh_folder(out, ("robustness.png",))

    assert list(out.iterdir()) == []


def test_files_of_others_are_not_touched(tmp_path):
    (tmp_path / "thesis.tex").write_text("all of it")
    with pytest.raises(UsageError, match="holds other files"):
        fresh_folder(tmp_path)
    assert (tmp_path / "thesis.tex").exists()


def test_only_named_files_and_folders_of_an_earlier_run_are_removed(tmp_path):
    for name in ("events.jsonl", "report.json", "notes.txt", "map.png"):
        (tmp_path / name).write_text("")
    (tmp_path / "robot-1").mkdir()
    (tmp_path / "mine").mkdir()

    fresh_folder(tmp_path, ["map.png"], ["robot-*"])

    assert sorted(each.name for each in tmp_path.iterdir()) == ["mine", "notes.txt"]


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(UsageError, match="is a file"):
        fresh_folder(tmp_path / "out")


def test_a_report_names_machine_load_and_settings(tmp_path):
    settings = PlatformSettings()

    page = finish_report(tmp_path, {"experiment": "x"}, lambda report: "# x\n", settings, [0.1, 0.2, 0.3])

    assert page == (tmp_path / "report.md").read_text() == "# x\n"

    around = json.loads((tmp_path / "report.json").read_text())["environment"]
    assert around["load_average"] == [0.1, 0.2, 0.3]
    assert len(around["load_average_after"]) == 3
    assert around["settings_digest"] == settings.digest()
    assert "numpy" in around["versions"]
