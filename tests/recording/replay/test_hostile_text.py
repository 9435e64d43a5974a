"""Recordings with hostile text: `rse-pf replay` writes nothing that a terminal obeys."""

from __future__ import annotations

from pathlib import Path

import pytest

from rse_pf.cli.main import main
from rse_pf.wire import Failure
from tests.kit.hostile_text import HOSTILE, obeyed
from tests.kit.recorded_sessions import Made


def test_hostile_text_of_a_recording_is_escaped(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    made = Made(tmp_path / "recording", server=HOSTILE)
    made.send(1, answer=Failure(id=0, code=HOSTILE, message=HOSTILE, hint=HOSTILE), trace=HOSTILE[:64])

    assert main(["replay", str(made.close())]) in (0, 1)

    shown = capfd.readouterr()
    assert "Traceback" not in shown.err
    assert obeyed(shown.out + shown.err) == set()
    assert shown.out.strip(), "nothing is shown"
