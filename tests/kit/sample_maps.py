"""Small maps with every kind of content, for the tests of this folder."""

from __future__ import annotations

import numpy as np

from rse_pf.geometry import Camera, exp_se3, inverse
from rse_pf.maps.format import Edge, Keyframe, MapVersion

CAMERA = Camera(fx=500.0, fy=500.0, cx=320.0, cy=240.0, width=640, height=480)


def make_map(seed: int = 1, keyframes: int = 4, points: int = 20) -> MapVersion:
    rng = np.random.default_rng(seed)
    poses = [exp_se3(rng.normal(0.0, 0.5, 6)) for _ in range(keyframes)]
    depth = rng.normal(2.0, 0.3, (7, 3)).astype(np.float32)
    depth[2] = np.nan
    return MapVersion(
        keyframes=tuple(
            Keyframe(
                id=n * 10,
                robot=f"robot-{n % 2 + 1}",
                timestamp_s=100.0 + n,
                T_world_camera=pose,
                camera=CAMERA,
                pixels=rng.uniform(0, 600, (7, 2)).astype(np.float32),
                descriptors=rng.integers(0, 256, (7, 32), dtype=np.uint8),
                points_camera=depth,
            )
            for n, pose in enumerate(poses)
        ),
        edges=tuple(
            Edge(
                a=n * 10,
                b=n * 10 + 10,
                T_a_b=inverse(poses[n]) @ poses[n + 1],
                information=np.diag([100.0, 100.0, 100.0, 400.0, 400.0, 400.0]),
                kind="odometry" if n else "loop",
            )
            for n in range(keyframes - 1)
        ),
        points=rng.normal(0, 1, (points, 3)).astype(np.float32),
        colours=rng.integers(0, 256, (points, 3), dtype=np.uint8),
        provenance={"made": "by a test", "seed": seed},
    )
