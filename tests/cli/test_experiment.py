"""A wrong option of an experiment is one line with a hint, before anything starts."""

from __future__ import annotations

import pytest

from rse_pf.cli.main import main


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["elasticity", "--robots", "0"], "--robots 0 is not within 1..2000"),
        (["elasticity", "--speed", "0.5"], "--speed 0.5 is not within 1..100"),
        (["elasticity", "--speed", "nan"], "--speed nan"),
        (["elasticity", "--fps", "inf"], "--fps inf"),
        (["elasticity", "--emulated-cores", "0"], "--emulated-cores 0"),
        (["elasticity", "--as-cloud", "--speed", "11"], "--speed 11 makes a sample of the fast profile"),
        (["elasticity", "--as-cloud", "--compare"], "--as-cloud compares two designs of its own"),
        (["latency", "--link", "papre"], "no link named 'papre'"),
        (["robustness", "--only", "kill,fire"], "there is no fault 'fire'"),
        (["live", "--only", "kill,balancer"], "there is no fault 'balancer'"),
        (["robustness", "--repeat", "0"], "--repeat 0"),
        (["map", "--robots", "33"], "--robots 33 is not within 1..32"),
        (["latency", "somewhere"], "latency takes no folder"),
        (["verify"], "verify needs a folder"),
        (["elasticty"], "'elasticty' is not one of"),
    ],
)
def test_a_wrong_option_is_refused_with_a_hint_and_nothing_starts(words, told, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    code = main(["experiment", *words])

    told_here = capsys.readouterr().err
    assert (code, told in told_here, "hint: " in told_here) == (2, True, True)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_with_other_files_is_not_touched(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("all of it")

    code = main(["experiment", "latency", "--robots", "1", "--out", str(tmp_path)])

    assert code == 2
    assert "holds other files" in capsys.readouterr().err
    assert (tmp_path / "thesis.tex").read_text() == "all of it"


def test_verify_names_what_is_missing(tmp_path, capsys):
    assert main(["experiment", "verify", str(tmp_path)]) == 2
    assert "report.json" in capsys.readouterr().err
