"""The law of one place: what `rse_pf.slam` does is defined nowhere else.

Names are compared without their leading underscores and plurals, so that a private copy is found, too.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping

import pytest

ONE_PLACE = {
    "exp_se3": "rse_pf/geometry.py",
    "log_se3": "rse_pf/geometry.py",
    "adjoint": "rse_pf/geometry.py",
    "skew": "rse_pf/geometry.py",
    "median_pose": "rse_pf/geometry.py",
    "rigid": "rse_pf/geometry.py",
    "RelativePoseOptions": "rse_pf/slam/relative_pose.py",
    "MeasureOptions": "rse_pf/slam/relative_pose.py",
    "measure_pose": "rse_pf/slam/relative_pose.py",
    "hamming_matche": "rse_pf/slam/descriptors.py",
    "round_trips_close": "rse_pf/slam/consistency.py",
    "within_noise": "rse_pf/slam/consistency.py",
    "largest_clique": "rse_pf/slam/consistency.py",
    "LocalisationOptions": "rse_pf/slam/localise.py",
    "RelocaliseOptions": "rse_pf/slam/localise.py",
    "place_vector": "rse_pf/slam/places.py",
    "view_vector": "rse_pf/slam/places.py",
    "PlaceIndex": "rse_pf/slam/places.py",
    "VectorIndex": "rse_pf/slam/places.py",
    "encode_ply": "rse_pf/slam/ply.py",
    "decode_ply": "rse_pf/slam/ply.py",
    "read_g2o": "rse_pf/slam/pose_graph.py",
}
"""Functions and classes, and the file that defines them."""
ONE_WRITER = {
    "11.345": "rse_pf/slam/consistency.py",
    "end_header": "rse_pf/slam/ply.py",
    "VERTEX_SE3": "rse_pf/slam/pose_graph.py",
}
"""Words that only a reader or writer of a format needs, and the file that has them."""


def second_copies(tree: Mapping[str, str]) -> list[str]:
    """Return the definitions in *tree* (path to text) whose name belongs to another file, one line each."""
    wrong = [
        f"{path}: {word!r} belongs to {owner}"
        for path, text in tree.items()
        for word, owner in ONE_WRITER.items() if path != owner and word in text
    ]  # fmt: skip
    for path, text in tree.items():
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                continue
            name = node.name.lstrip("_").removesuffix("_many")
            owner = ONE_PLACE.get(name) or ONE_PLACE.get(name.removesuffix("s"))
            if owner is not None and owner != path:
                wrong.append(f"{path}: {node.name} is what {owner} defines")
    return wrong


def test_what_slam_defines_is_defined_once(sources: Mapping[str, str]) -> None:
    assert second_copies(sources) == []
    assert set(ONE_PLACE.values()) <= sources.keys()


@pytest.mark.parametrize(
    "text",
    [
        "def log_se3(T): ...",
        "def exp_se3_many(xi): ...",
        "class A:\n    def _adjoints(self): ...",
        "HEADER = b'end_header'",
    ],
)
def test_a_second_copy_is_found(text: str) -> None:
    assert len(second_copies({"rse_pf/live_map/agreement.py": text})) == 1
