"""The verb of the rosbridge server: wrong options are refused in two lines before it listens."""

from __future__ import annotations

import pytest

from rse_pf.cli.main import main


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (("--url", "platform.example"), "is not the address of a platform"),
        (("--url", "http://127.0.0.1/ws"), "is not the address of a platform"),
        (("--port", "70000"), "70000 is not a port"),
        (("--announce", "/nowhere/at/all"), "there is no folder /nowhere/at"),
    ],
)
def test_wrong_options_are_refused_with_a_hint(
    capsys: pytest.CaptureFixture[str], options: tuple[str, ...], problem: str
) -> None:
    assert main(["rosbridge", *options]) == 2
    first, hint = capsys.readouterr().err.splitlines()

    assert problem in first
    assert hint.startswith("  hint: ")
