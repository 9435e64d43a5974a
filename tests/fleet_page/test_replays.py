"""What the page shows of a replayed command: if it is equal, the rules that it broke, and its matches."""

from __future__ import annotations

from pathlib import Path

from rse_pf.config import PlatformSettings
from rse_pf.extensions.fleet_page.replays import replay_document
from rse_pf.extensions.recording.replay import run
from rse_pf.pnp.problems import make_problem
from tests.kit.recorded_sessions import Made


def test_a_weak_pose_shows_its_matches_and_the_rules_that_it_broke(tmp_path: Path) -> None:
    made = Made(tmp_path / "rec")
    name = made.send(make_problem(seed=9, n=60, outlier_ratio=0.8))

    reported = replay_document(run.report(made.close(), PlatformSettings(), name))

    assert reported["equal"]
    assert reported["picture"].startswith("data:image/png;base64,")
    broken = [line for line in reported["lines"] if ", not at " in line]
    assert [line.partition(":")[0] for line in broken] == ["low-inlier-ratio"]
    assert not any(" ," in line for line in reported["lines"])
    assert reported["lines"][0].startswith("verdict weak: low-inlier-ratio; engine ")
