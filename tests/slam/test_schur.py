"""The Schur complement gives the same step as the whole system of equations."""

from __future__ import annotations

import numpy as np
import pytest

from rse_pf.slam.schur import NormalEquations


@pytest.mark.parametrize(("damping", "prior"), [(0.0, 0.0), (1e-3, 0.5), (10.0, 1e-9)])
def test_the_step_is_that_of_the_whole_system(damping: float, prior: float) -> None:
    rng = np.random.default_rng(4)
    cameras, landmarks = 12, 30
    size = cameras + 3 * landmarks
    J = np.zeros((400, size))
    J[:, :cameras] = rng.normal(size=(400, cameras))
    for row, landmark in enumerate(rng.integers(0, landmarks, 400)):
        J[row, cameras + 3 * landmark : cameras + 3 * landmark + 3] = rng.normal(size=3)
    whole, gradient = J.T @ J, J.T @ rng.normal(size=400)
    blocks = whole[cameras:, cameras:].reshape(landmarks, 3, landmarks, 3)
    equations = NormalEquations(
        whole[:cameras, :cameras].copy(),
        gradient[:cameras],
        whole[cameras:, :cameras].reshape(landmarks, 3, cameras),
        blocks[np.arange(landmarks), :, np.arange(landmarks)],
        gradient[cameras:].reshape(landmarks, 3),
    )

    reduced = equations.reduce(damping, prior, prior)
    step = np.linalg.solve(reduced.S, reduced.right)
    of_landmarks = equations.landmark_steps(reduced, step)

    damped = whole + np.diag(damping * np.diag(whole) + prior)
    wanted = np.linalg.solve(damped, -gradient)
    np.testing.assert_allclose(step, wanted[:cameras], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(of_landmarks.ravel(), wanted[cameras:], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        reduced.landmark_covariance[0] @ damped[cameras : cameras + 3, cameras : cameras + 3],
        np.eye(3),
        atol=1e-9,
    )
