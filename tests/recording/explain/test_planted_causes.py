"""Causes that are planted in commands of a rendered world, as the benchmark does."""

from __future__ import annotations

import pytest

from benchmarks.recording.planted_causes import PLANTED, healthy_case, plant_case, render_sequence
from rse_pf.recording.explain import Cause, explain

pytestmark = pytest.mark.slow


def test_names_nearly_all_causes_in_a_rendered_world() -> None:
    sequence = render_sequence(2)
    cases = [(cause, plant_case(sequence, 500 + k, cause, 2)) for k, cause in enumerate(PLANTED)]
    cases += [(Cause.NONE, healthy_case(sequence, 600 + k)) for k in range(5)]

    named = [
        explain(
            case.query, case.reply, thumbnail=case.thumbnail, history=case.history, timing=case.timing,
            T_odom_camera=case.T_odom_camera,
        )[0].cause
        for _, case in cases
    ]  # fmt: skip

    right = [wanted is given for (wanted, _), given in zip(cases, named, strict=True)]
    assert sum(right) >= len(cases) - 1, named
    assert all(right[len(PLANTED) :])
