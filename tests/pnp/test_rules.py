"""The rules of the evidence: the solver decides by them, and nothing else has a second copy."""

from __future__ import annotations

import ast
from collections.abc import Mapping

import pytest

from rse_pf.errors import BadRequest, PnpError
from rse_pf.pnp import PnpOptions, WeakLimits, available_engines, solve_pnp
from rse_pf.pnp.problems import DEGENERATE, PnpProblem, make_degenerate, make_problem
from rse_pf.pnp.rules import PoseJudgement, Rule

RULES = "rse_pf/pnp/rules.py"
MEASURES = {"Shape", "independent_inliers", "inverse_of_information", "second_planar_pose"}
"""What only rules about a pose measure."""
LIMITS = {"COLLINEAR", "NEARLY_COLLINEAR", "WEAK_PERSPECTIVE", "SAME_FIT", "SIMILAR_FIT", "NOISE_FLOOR_PX2"}


def second_rules(tree: Mapping[str, str]) -> list[str]:
    """Return where *tree* (path to text) judges poses beside `RULES`, one line each."""
    found = []
    for path, text in tree.items():
        if path.startswith(("rse_pf/pnp/evidence", "rse_pf/pnp/planar_ambiguity", "rse_pf/native.py", RULES)):
            continue
        for node in ast.walk(ast.parse(text)):
            match node:
                case ast.Attribute(value=ast.Name(id="evidence"), attr=name) if name in MEASURES:
                    found.append(f"{path}: measures {name}")
                case ast.alias(name=name) if name in MEASURES:
                    found.append(f"{path}: imports {name}")
                case ast.Name(id=name, ctx=ast.Store()) if name.lstrip("_") in LIMITS:
                    found.append(f"{path}: has the limit {name}")
    return found


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


def test_the_sources_have_the_rules_once(sources: Mapping[str, str]) -> None:
    assert second_rules(sources) == []


@pytest.mark.parametrize(
    "text",
    ["shape = evidence.Shape(view, camera)", "_SAME_FIT = 9.0", "from rse_pf.pnp.evidence import Shape"],
)
def test_a_second_copy_of_a_rule_is_noticed(text: str) -> None:
    assert len(second_rules({"rse_pf/recording/replay/rules.py": text})) == 1


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
