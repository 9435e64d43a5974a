"""Eliminate landmarks from the normal equations of a bundle adjustment by the Schur complement.

Source: Triggs et al., "Bundle Adjustment - A Modern Synthesis", 2000, Sect. 6.1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rse_pf.geometry import Array

__all__ = ["NormalEquations", "ReducedEquations"]


@dataclass(slots=True, eq=False)
class NormalEquations:
    """Gauss-Newton equations of *c* camera parameters and *l* landmarks.

    Attributes:
        H: ``(c, c)``, the block of the camera parameters.
        g: ``(c,)``, the gradient ``J^T r`` of the camera parameters for the residuals *r*, model minus
            observation; a step goes against it.
        E: ``(l, 3, c)``, the blocks between landmarks and camera parameters.  In this layout the array is
            also a ``(3 l, c)`` matrix, so that `reduce` computes the large product as one matrix transposed
            times itself.
        H_landmarks: ``(l, 3, 3)``, the blocks of the landmarks.
        g_landmarks: ``(l, 3)``, the gradients ``J^T r`` of the landmarks.
    """

    H: Array
    g: Array
    E: Array
    H_landmarks: Array
    g_landmarks: Array

    def reduce(self, damping: float, prior: float | Array, landmark_prior: float) -> ReducedEquations:
        """Return the equations of the camera parameters alone, damped as Levenberg-Marquardt does.

        Damping and priors are added to the matrices only, not to the right side.

        Args:
            damping: Share of each diagonal element that is added to this element.
            prior: Information that is added to the diagonal of the camera parameters, a number or ``(c,)``.
            landmark_prior: Information that is added to the diagonal of each landmark.

        Raises:
            numpy.linalg.LinAlgError: The block of a landmark is not positive definite: the observations do
                not determine this landmark.
        """
        c = len(self.g)
        # 1. Factor the damped blocks of the landmarks: inverse(block) = root^T root.
        damped = self.H_landmarks * (1.0 + damping * np.eye(3)) + landmark_prior * np.eye(3)
        root: Array = np.linalg.inv(np.linalg.cholesky(damped)).astype(np.float64, copy=False)
        # 2. Subtract E^T inverse(block) E from H, and E^T inverse(block) g_landmarks from g.
        Z = (root @ self.E).reshape(3 * len(self.E), c)
        S = self.H - Z.T @ Z
        right = (root @ self.g_landmarks[:, :, None]).ravel() @ Z - self.g
        # 3. Damp the camera parameters.
        diagonal = np.arange(c)
        S[diagonal, diagonal] += damping * self.H[diagonal, diagonal] + prior
        return ReducedEquations(S, right, root.transpose(0, 2, 1) @ root)

    def landmark_steps(self, reduced: ReducedEquations, step: Array) -> Array:
        """Return the steps ``(l, 3)`` of the landmarks for the *step* ``(c,)`` of the camera parameters.

        *reduced* is what `reduce` returned for these equations, with the damping of the landmarks.
        """
        right = -(self.g_landmarks + self.E @ step)
        return (reduced.landmark_covariance @ right[:, :, None])[:, :, 0]


@dataclass(frozen=True, slots=True, eq=False)
class ReducedEquations:
    """The equations ``S step = right`` of the camera parameters, after the landmarks were eliminated.

    Attributes:
        S: ``(c, c)``, the Schur complement, with the damping and the prior of the camera parameters.
        right: ``(c,)``, the right side.
        landmark_covariance: ``(l, 3, 3)``, the inverses of the damped blocks of the landmarks.
    """

    S: Array
    right: Array
    landmark_covariance: Array
