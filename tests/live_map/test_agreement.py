"""A link agrees with the graph in its shift and its turn; of one keyframe's links only a few count."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rse_pf.geometry import Array, exp_se3
from rse_pf.live_map.agreement import _tested, judge_within
from rse_pf.live_map.graph import LiveLink
from rse_pf.live_map.options import LiveMapOptions

OPTIONS = LiveMapOptions()


def link(a: int, b: int, T_a_b: Array, inliers: int = 100) -> LiveLink:
    return LiveLink(
        a=a, b=b, T_a_b=T_a_b, information=np.eye(6), inliers=inliers, matches=200,
        variances=np.full(6, 1e-6),
    )  # fmt: skip


def two_keyframes(measured: Array) -> Any:
    """Return a graph whose two keyframes have one pose, and a link that measured another one."""
    return SimpleNamespace(T=np.array([np.eye(4)] * 2), links={7: link(0, 1, measured)})


@pytest.mark.parametrize(
    ("twist", "verdict"),
    [
        ((0.001, 0, 0, 0, 0, 0), "agrees"),
        ((0, 0, 0, 0, 0, 0.001), "agrees"),
        ((0.5, 0, 0, 0, 0, 0), "contrary"),
        ((0, 0, 0, 0, 0, 0.5), "contrary"),
    ],
)
def test_a_link_that_is_shifted_or_turned_against_the_graph_is_contrary(
    twist: tuple[float, ...], verdict: str
) -> None:
    graph = two_keyframes(exp_se3(np.array(twist)))

    assert judge_within(graph, [7], [1.0], OPTIONS) == [verdict]


def test_only_the_best_links_of_a_keyframe_are_tested() -> None:
    count = OPTIONS.links_of_keyframe
    graph: Any = SimpleNamespace(
        links={row: link(0, 1 + row, np.eye(4), inliers=50 + row) for row in range(count + 3)}
    )

    assert _tested(graph, list(graph.links), OPTIONS) == list(range(3, count + 3))
