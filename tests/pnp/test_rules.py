"""The rules of the evidence: the solver decides by them."""

from __future__ import annotations

import pytest

from rse_pf.errors import BadRequest, PnpError
from rse_pf.pnp import PnpOptions, WeakLimits, available_engines, solve_pnp
from rse_pf.pnp.problems import DEGENERATE, PnpProblem, make_degenerate, make_problem
from rse_pf.pnp.rules import PoseJudgement, Rule


def judged(problem: PnpProblem, T_camera_world: object) -> list[Rule]:
    judgement = PoseJudgement(
        T_camera_world, problem.points_world, problem.pixels, problem.camera,
        inlier_px=PnpOptions().inlier_px, weak=WeakLimits(),
    )  # fmt: skip
    return [rule for rule, _ in judgement.ask()]


def problems() -> list[PnpProblem]:
    ratios = (0.0, 0.3, 0.5, 0.7, 0.8, 0.9)
    return [
        *(
            make_problem(seed=seed, n=n, outlier_ratio=ratio)
            for seed in range(4)
            for n in (6, 12, 60)
            for ratio in ratios
        ),
        *(make_degenerate(kind, seed=seed) for kind in DEGENERATE for seed in range(4)),
    ]


@pytest.mark.parametrize("engine", available_engines())
def test_the_rules_that_a_pose_breaks_are_the_reason_of_its_verdict(engine: str) -> None:
    verdicts: dict[str, int] = {}
    for problem in problems():
        try:
            solution = solve_pnp(
                problem.points_world, problem.pixels, problem.camera, PnpOptions(engine=engine)
            )
        except (BadRequest, PnpError):
            continue
        rules = judged(problem, solution.T_camera_world)
        broken = [rule.name for rule in rules if not rule.is_kept]

        assert all(rule.is_kept for rule in rules if rule.refuses)
        assert solution.reason == ("ambiguous" if "ambiguous" in broken else next(iter(broken), ""))
        verdicts[solution.reason] = verdicts.get(solution.reason, 0) + 1

    assert verdicts[""] >= 5
    assert len(verdicts) >= 3, "some poses are weak, for more than one reason"


def test_without_a_pose_the_rules_say_why() -> None:
    problem = make_problem(seed=1, n=20, outlier_ratio=0.0)

    rules = judged(problem, None)

    assert [(rule.name, rule.is_kept) for rule in rules] == [
        ("too-few", True), ("no-consensus", False), ("degenerate", True),
    ]  # fmt: skip
