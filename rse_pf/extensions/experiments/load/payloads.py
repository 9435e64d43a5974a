"""The payloads that both load generators send, each encoded once, with the correct answer to it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from rse_pf.config import SessionSettings
from rse_pf.extensions.experiments.load.scenario import LoadScenario
from rse_pf.geometry import Array
from rse_pf.pnp.problems import make_problem
from rse_pf.services.pnp import make_request
from rse_pf.wire import make_codec
from rse_pf.wire.preencoded import PreencodedCommand, preencode

__all__ = ["SolvedPayload", "is_right", "make_payloads"]

# Number of different payloads that a load repeats: enough that caches of servers have no effect.
_DIFFERENT_PAYLOADS = 64
# Largest distance, in metres, of the camera centre of a correct pose from the truth; with 200 matches the
# error is one or two centimetres.
_MAX_POSITION_ERROR_M = 0.05
# Largest rotation, in radians, of a correct pose relative to the truth.
_MAX_ROTATION_ERROR_RAD = math.radians(1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class SolvedPayload:
    """An encoded payload and its correct answer: the pose of a PnP problem, or the numbers of an echo."""

    payload: PreencodedCommand
    T_camera_world: Array | None = None
    echo: list[float] | None = None


def make_payloads(scenario: LoadScenario, session: SessionSettings) -> list[SolvedPayload]:
    """Return 64 seeded payloads for the service of *scenario*, encoded by its codec, with their answers."""
    codec = make_codec(scenario.codec, session)
    if scenario.service == "echo":
        numbers = np.random.default_rng(scenario.seed).integers(
            0, 1000, (_DIFFERENT_PAYLOADS, max(1, scenario.matches))
        )
        return [SolvedPayload(payload=preencode(codec, {"value": row}), echo=row) for row in numbers.tolist()]
    pool = []
    for number in range(_DIFFERENT_PAYLOADS):
        problem = make_problem(
            seed=scenario.seed + number, n=scenario.matches, outlier_ratio=scenario.outliers
        )
        request = make_request(
            problem.points_world, problem.pixels, problem.camera, binary=scenario.codec == "bin"
        )
        pool.append(SolvedPayload(payload=preencode(codec, request), T_camera_world=problem.T_camera_world))
    return pool


def is_right(problem: SolvedPayload, reply: Any) -> bool:
    """Return whether *reply* is correct: an equal echo, or a pose within 5 cm and 1 degree of the true one.

    A reply that lacks the expected value, or has another shape, is not correct.
    """
    try:
        if problem.T_camera_world is None:
            return bool(reply["value"] == problem.echo)
        T = np.asarray(reply["T_camera_world"], dtype=np.float64).reshape(4, 4)
    except (KeyError, TypeError, ValueError):
        return False
    truth = problem.T_camera_world
    centres = T[:3, :3].T @ T[:3, 3] - truth[:3, :3].T @ truth[:3, 3]
    cosine = (float(np.vdot(T[:3, :3], truth[:3, :3])) - 1.0) / 2.0
    return float(centres @ centres) <= _MAX_POSITION_ERROR_M**2 and cosine >= math.cos(
        _MAX_ROTATION_ERROR_RAD
    )
