"""What the tests of several verbs share."""

from __future__ import annotations

from pathlib import Path

import pytest

from rse_pf.local.firewall import ensure_key


@pytest.fixture
def platform(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a platform that has run once; the working folder is a robot's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    folder = tmp_path / "rse-pf" / "default"
    folder.mkdir(parents=True)
    ensure_key(folder, seed=b"s" * 32, key_id="k")
    return folder
