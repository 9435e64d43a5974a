"""The listed rules decide as the native solver does."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.errors import BadRequest
from rse_pf.geometry import Array
from rse_pf.pnp import PnpOptions, WeakLimits, available_engines
from rse_pf.pnp.engines import engine_for, native_options
from rse_pf.pnp.native_solver import Evidence, native_solver
from rse_pf.pnp.problems import DEGENERATE, PnpProblem, make_degenerate, make_problem
from rse_pf.pnp.rules import Rule, evaluate_rules

OPTIONS, LIMITS = PnpOptions(), WeakLimits()


def rules(problem: PnpProblem, found: Evidence | None) -> tuple[Rule, ...]:
    return evaluate_rules(len(problem.pixels), found, inlier_px=OPTIONS.inlier_px, weak=LIMITS)


def evidence_of(problem: PnpProblem, T_camera_world: Array) -> Evidence:
    limits = native_options(OPTIONS, LIMITS)
    return native_solver().evaluate(
        problem.points_world, problem.pixels, problem.camera, limits, T_camera_world
    )


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
    refused = 0
    for problem in problems():
        try:
            found = engine_for(engine)(problem.points_world, problem.pixels, problem.camera, OPTIONS, LIMITS)
        except BadRequest:
            continue
        broken = [rule for rule in rules(problem, found) if not rule.is_satisfied]
        if found.refusal is not None:
            refused += 1
            # The test for mirrored points is not among the rules.
            assert any(rule.refuses for rule in broken) or "mirrored" in found.refusal.message
            continue
        names = [rule.name for rule in broken]

        assert not any(rule.refuses for rule in broken)
        assert found.reason == ("ambiguous" if "ambiguous" in names else next(iter(names), ""))
        verdicts[found.reason] = verdicts.get(found.reason, 0) + 1

    assert refused >= 20
    assert verdicts[""] >= 5
    assert len(verdicts) >= 3, "some poses are weak, for more than one reason"


def test_without_a_pose_the_rules_say_why() -> None:
    problem = make_problem(seed=1, n=20, outlier_ratio=0.0)

    found = evidence_of(problem, np.full((4, 4), np.nan))

    assert [(rule.name, rule.is_satisfied) for rule in rules(problem, found)] == [
        ("too-few", True), ("no-consensus", False), ("degenerate", True),
    ]  # fmt: skip


def test_a_refused_pose_shows_the_rules_behind_the_first_that_refuses() -> None:
    problem = make_degenerate("duplicated", seed=1)

    found = engine_for("native")(problem.points_world, problem.pixels, problem.camera, OPTIONS, LIMITS)

    shown = rules(problem, found)

    assert found.refusal is not None
    assert next(rule.name for rule in shown if not rule.is_satisfied) == "no-consensus"
    assert {"few-inliers", "clustered", "poorly-constrained"} <= {rule.name for rule in shown}
