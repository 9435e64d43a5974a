"""Eliminate landmarks from the normal equations of a bundle adjustment by the Schur complement.

Source: Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000, Sect. 6.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rse_pf.geometry import Array

__all__ = ["NormalEquations", "Reduced"]


@dataclass(slots=True, eq=False)
class NormalEquations:
    """Gauss-Newton equations of *c* camera parameters and *l* landmarks.

    Attributes:
        H: ``(c, c)``, of the camera parameters.
        g: ``(c,)``, their gradient.
        E: ``(l, 3, c)``, between landmarks and camera parameters; the rows of a landmark lie together, so
            that the large product below is of one array with itself.
        H_landmarks: ``(l, 3, 3)``, of the landmarks.
        g_landmarks: ``(l, 3)``, their gradient.
    """

    H: Array
    g: Array
    E: Array
    H_landmarks: Array
    g_landmarks: Array

    def reduce(self, damping: float, prior: float | Array, landmark_prior: float) -> Reduced:
        """Return the equations of the camera parameters alone, damped as Levenberg-Marquardt does.

        Args:
            damping: Share of each diagonal that is added to it.
            prior: Information that is added to the diagonal of the camera parameters, one number or ``(c,)``.
            landmark_prior: Information that is added to the diagonal of each landmark.

        Raises:
            numpy.linalg.LinAlgError: A landmark is not determined.
        """
        size = len(self.g)
        damped = self.H_landmarks * (1.0 + damping * np.eye(3)) + landmark_prior * np.eye(3)
        root: Array = np.linalg.inv(np.linalg.cholesky(damped)).astype(np.float64, copy=False)
        Z = (root @ self.E).reshape(3 * len(self.E), size)
        S = self.H - Z.T @ Z
        right = (root @ self.g_landmarks[:, :, None]).ravel() @ Z - self.g
        diagonal = np.arange(size)
        S[diagonal, diagonal] += damping * self.H[diagonal, diagonal] + prior
        return Reduced(S, right, root.transpose(0, 2, 1) @ root)

    def landmark_steps(self, reduced: Reduced, step: Array) -> Array:
        """Return the ``(l, 3)`` steps of the landmarks that belong to the *step* ``(c,)`` of the cameras."""
        back = -(self.g_landmarks + self.E @ step)
        steps: Array = (reduced.landmark_covariance @ back[:, :, None])[:, :, 0]
        return steps


@dataclass(frozen=True, slots=True, eq=False)
class Reduced:
    """Equations ``S step = right`` of the camera parameters.

    ``landmark_covariance`` ``(l, 3, 3)`` is the inverse of the landmarks' damped blocks.
    """

    S: Array
    right: Array
    landmark_covariance: Array
