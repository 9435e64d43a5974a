"""``rse-pf serve``: what it refuses before anything listens."""

from __future__ import annotations

from pathlib import Path

import pytest

from rse_pf.cli.main import main


@pytest.mark.parametrize(
    ("text", "mode", "word"),
    [(None, 0, "cannot read"), ("ab" * 16, 0o644, "others may read"), ("ab" * 15, 0o600, "32")],
)
def test_a_control_token_that_is_no_secret_is_two_lines(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str | None, mode: int, word: str
) -> None:
    file = tmp_path / "control.token"
    if text is not None:
        file.write_text(text)
        file.chmod(mode)

    assert main(["serve", "--control-token", str(file)]) == 2

    complaint, hint = capsys.readouterr().err.splitlines()
    assert word in complaint
    assert "control" in complaint
    assert hint.strip().startswith("hint: ")
