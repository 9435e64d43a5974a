"""Search for numbers that hurt the solver: run as a process of its own, because a crash must be seen.

``python geometry_examples.py COUNT SEED`` prints one JSON object.  Promises that equal seeds give equal
examples.
"""

from __future__ import annotations

import json
import math
import sys
import time
from collections import Counter
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fuzz.targets import check_pose
from rse_pf.config import PlatformSettings
from rse_pf.geometry import Camera
from rse_pf.pnp.problems import DEGENERATE, KINECT, make_degenerate
from rse_pf.service import dispatch
from rse_pf.services.builtin import builtin_services
from rse_pf.wire import Command, Failure

ENGINES = ("native", "opencv")
REGISTRY = builtin_services(PlatformSettings())

any_number = st.floats(width=64, allow_nan=True, allow_infinity=True, allow_subnormal=True)
scales = (
    any_number,
    st.floats(-1e6, 1e6),
    st.floats(-10.0, 700.0),
    st.integers(-3, 3).map(float),
    st.sampled_from([0.0, -0.0, 5e-324, 1e-300, 1e-12, 1.0, 1e6, -1e6, 1e300, math.nan, math.inf]),
)
lengths = st.sampled_from([0, 1, 3, 4, 5, 6, 7, 12, 40])


def camera_of(draw: Any) -> dict[str, Any]:
    """Return a camera's fields: mostly sane, some absurd."""
    sane = {name: getattr(KINECT, name) for name in Camera.__struct_fields__}
    if draw(st.integers(0, 3)):
        return sane
    name = draw(st.sampled_from(sorted(sane)))
    return {**sane, name: draw(any_number if name not in ("width", "height") else st.integers(-5, 10**6))}


@st.composite
def requests(draw: Any) -> dict[str, Any]:
    """Return the payload of a pnp command: any numbers, a line, noise, or a kind that fixes no pose."""
    payload: dict[str, Any] = {"camera": camera_of(draw)}
    form = draw(st.sampled_from(["any", "line", "noise", *DEGENERATE]))
    n = draw(lengths)
    if form == "any":
        elements = draw(st.sampled_from(scales))
        points = draw(hnp.arrays(np.float64, (n, 3), elements=elements))
        pixels = draw(hnp.arrays(np.float64, (n, 2), elements=draw(st.sampled_from(scales))))
    elif form == "line":
        start, along = (draw(hnp.arrays(np.float64, 3, elements=st.floats(-5, 5))) for _ in range(2))
        points = start + np.linspace(0.0, 1.0, n)[:, None] * along
        pixels = KINECT.project(points + np.array([0.0, 0.0, 6.0])) if n else np.zeros((0, 2))
    else:
        problem = make_degenerate(
            form, seed=draw(st.integers(0, 10**6)), n=draw(st.sampled_from([4, 8, 40, 200]))
        )
        points, pixels = problem.points_world, problem.pixels
    payload |= {"points_world": points.ravel(), "pixels": np.asarray(pixels).ravel()}
    payload["options"] = {
        "engine": draw(st.sampled_from(ENGINES)),
        **draw(st.sampled_from([{}, {}, {"inlier_px": draw(any_number)}, {"confidence": draw(any_number)},
               {"max_iterations": draw(st.integers(-5, 1200))},
               {"max_iterations": 2**31 - 1}])),
    }  # fmt: skip
    payload["form"] = form
    return payload


def search(count: int, begin: int) -> dict[str, Any]:
    """Try *count* examples; return counts of the answers and the dearest one's processor time."""
    answers: Counter[str] = Counter()
    worst_ms = 0.0

    @seed(begin)
    @settings(
        max_examples=count, deadline=None, database=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(payload=requests())
    def one(payload: dict[str, Any]) -> None:
        nonlocal worst_ms
        form = payload.pop("form")
        started = time.thread_time()
        answer = dispatch(REGISTRY, Command(id=1, service="pnp", payload=payload), lambda: 0.0)
        worst_ms = max(worst_ms, (time.thread_time() - started) * 1e3)
        verdict = answer.code if isinstance(answer, Failure) else answer.reply.verdict
        answers[f"{'sent' if form == 'any' else form}: {verdict}"] += 1
        assert verdict != "internal", answer
        assert form == "any" or verdict != "ok", (form, payload)
        if not isinstance(answer, Failure):
            check_pose(answer, payload["points_world"].reshape(-1, 3))

    one()
    return {"examples": sum(answers.values()), "worst_ms": worst_ms, "answers": dict(sorted(answers.items()))}


if __name__ == "__main__":
    print(json.dumps(search(int(sys.argv[1]), int(sys.argv[2]))))
