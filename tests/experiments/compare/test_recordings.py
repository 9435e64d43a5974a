"""The drives of a comparison: formats, rates and names."""

from __future__ import annotations

from pathlib import Path

import pytest

from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.compare import recordings
from rse_pf.extensions.experiments.compare.recordings import drives_of
from tests.kit.compare_recordings import flat_drive


@pytest.fixture
def flat(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording of 10 Hz behind every path."""
    monkeypatch.setattr(recordings, "open_recording", lambda word, **_: flat_drive(20))


@pytest.mark.usefixtures("flat")
def test_each_rate_is_a_drive_and_one_above_the_recordings_plays_all_and_says_so() -> None:
    drives = drives_of(["x"], [5.0, 60.0, 10.0])

    assert [(drive.rate_hz, len(drive)) for drive in drives] == [
        (5.0, 10),
        (pytest.approx(10.0), 20),
    ]
    assert drives[0].notes == ()
    assert drives[1].notes == ("--rate 60 is above the recording's 10 Hz: all frames are played",)


def test_a_wrong_path_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="does not exist"):
        drives_of([str(tmp_path / "nothing")], [])
