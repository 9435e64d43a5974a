"""rse-pf cloud cost: the bill of a load, and prices of the operator."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rse_pf.cli.main import main


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No settings file of the checkout plays a part."""
    monkeypatch.chdir(tmp_path)


def test_the_bill_adds_up_line_by_line_and_box_by_box(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(["cloud", "cost", "--robots", "20", "--fps", "5", "--hours-per-day", "8", "--burst", "900"]) == 0
    )

    page = capsys.readouterr().out
    table = page.partition("USD/month\n")[2].partition("\n\n")[0].splitlines()
    lines = [float(row.split()[-1]) for row in table if not row.lstrip().startswith(("=", "total"))]
    boxes = [float(row.split()[-1]) for row in table if row.lstrip().startswith("=")]
    total = float(table[-1].split()[-1])
    assert len(lines) > 12
    assert len(boxes) == 7, "the six boxes of Fig. 2, and the Lambda"
    assert f"{sum(lines):.2f}" == f"{sum(boxes):.2f}" == f"{total:.2f}"
    assert f"{total / (20 * 730 / 3):.4f} USD" in page, "a robot for an hour"


def test_a_file_of_prices_replaces_ours(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    chosen = {"lambda_per_million": 1e6, "firewall_per_million": 0, "as_of": "2026-01-31", "currency": "EUR"}
    (tmp_path / "prices.json").write_text(json.dumps(chosen), encoding="utf-8")

    assert main(["cloud", "cost", "--prices", "prices.json", "--robots", "1", "--fps", "1"]) == 0

    page = capsys.readouterr().out
    assert "prices of 2026-01-31" in page
    assert "EUR/month" in page
    assert f"{730 * 3600}." in page, "one for each command"


def test_a_type_without_a_price_is_one_line_and_a_hint(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    document = {"context": {"rse-pf": {"cloud": {"instance_type": "z1d.large"}}}}
    (tmp_path / "mine.json").write_text(json.dumps(document), encoding="utf-8")

    assert main(["cloud", "--settings", str(tmp_path / "mine.json"), "cost"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("ConfigurationError: no price of z1d.large is known")
    assert "prices.json" in lines[1]


def test_a_load_beyond_the_settings_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cloud", "cost", "--robots", "10000", "--fps", "30"]) == 0

    assert "robots would be refused" in capsys.readouterr().out
