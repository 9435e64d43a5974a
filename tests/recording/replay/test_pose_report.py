"""`rse-pf replay --command`: the frame of a pose, its matches, and the evidence for its verdict."""

from __future__ import annotations

import base64
import io
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rse_pf.cli.main import main
from rse_pf.pnp.problems import make_degenerate, make_problem
from tests.kit.recorded_sessions import Made

MATCHES, INLIERS = 60, 12
BLUE, ORANGE = (0, 114, 178), (213, 94, 0)  # of matches that agree with the pose, and of those that do not


def black_frame() -> bytes:
    """Return the thumbnail of a frame that is black all over."""
    file = io.BytesIO()
    Image.new("RGB", (160, 120), "black").save(file, format="JPEG")
    return file.getvalue()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """A recording of a weak pose with its frame, and of a command that has no pose; the names of both."""
    made = Made(tmp_path_factory.mktemp("replay") / "recording")
    weak = make_problem(seed=9, n=MATCHES, outlier_ratio=1.0 - INLIERS / MATCHES)
    names = {
        "weak": made.send(weak, thumbnail=black_frame()),
        "refused": made.send(make_degenerate("coincident", seed=1, n=MATCHES), robot=1),
    }
    return made.close(), names


@pytest.mark.parametrize(
    ("command", "verdict", "inliers", "evidence", "is_dark", "colours"),
    [
        (
            "weak",
            "weak: low-inlier-ratio",
            INLIERS,
            ("WEAK", "low-inlier-ratio", "0.2, at least 0.25"),
            True,
            {BLUE, ORANGE},
        ),
        ("refused", "degenerate: ", 0, ("REFUSES", "degenerate", "0, at least 0.02"), False, {ORANGE}),
    ],
)
def test_a_replay_shows_verdict_evidence_and_the_matches_on_the_frame(
    recording: tuple[Path, dict[str, str]],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    command: str,
    verdict: str,
    inliers: int,
    evidence: tuple[str, str, str],
    is_dark: bool,
    colours: set[tuple[int, int, int]],
) -> None:
    (folder, names), page = recording, tmp_path / "page.html"

    code = main(["replay", str(folder), "--command", names[command], "--html", str(page)])

    written = capsys.readouterr()
    assert (code, written.err) == (0, "")
    lines = written.out.splitlines()
    says, rule, figures = evidence
    assert f"service pnp: {verdict}" in lines[0]
    assert any(f"{MATCHES} matches, {inliers} inliers" in line for line in lines)
    assert any(line.split()[:2] == [says, rule] and line.endswith(figures) for line in lines)
    assert "solved again: equal to the byte, but for times and places" in lines
    (picture,) = re.findall('src="data:image/png;base64,([^"]+)"', page.read_text(encoding="utf-8"))
    with Image.open(io.BytesIO(base64.b64decode(picture))) as image:
        pixels = np.asarray(image.convert("RGB"), dtype=np.int64).reshape(-1, 3)
    assert bool(np.median(pixels) < 128) == is_dark
    assert {BLUE, ORANGE} & set(map(tuple, np.unique(pixels, axis=0).tolist())) == colours
