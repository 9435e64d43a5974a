"""A robot that lies about its rig or its IMU: it is refused, or the other robots of the map are not moved."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.live.hostile_rigs import (
    ATTACKS,
    REFUSED,
    Outcome,
    SentDrive,
    generated_drives,
    play,
    tell_truth,
)


@pytest.fixture(scope="module")
def drives() -> dict[str, SentDrive]:
    return generated_drives(seed=1, keyframes=12)


@pytest.fixture(scope="module")
def alone(drives: dict[str, SentDrive]) -> Outcome:
    return play(drives, None)


@pytest.fixture(scope="module")
def truthful(drives: dict[str, SentDrive]) -> Outcome:
    return play(drives, tell_truth)


def same(one: Outcome, other: Outcome) -> bool:
    keys = sorted(one.poses)
    return keys == sorted(other.poses) and all(
        np.array_equal(one.poses[key], other.poses[key]) for key in keys
    )


def test_all_honest_robots_join(alone: Outcome, truthful: Outcome) -> None:
    assert len(alone.poses) == len(truthful.poses) == 36
    assert truthful.has_joined


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_what_cannot_be_true_is_refused_and_changes_nothing(
    name: str, drives: dict[str, SentDrive], alone: Outcome
) -> None:
    attacked = play(drives, ATTACKS[name])

    assert (attacked.accepted, attacked.refused) == (0, 12)
    assert attacked.why
    assert same(attacked, alone)


@pytest.mark.parametrize("name", ["unknown-optional", "false-gravity", "false-motion"])
def test_false_blocks_move_nobody(name: str, drives: dict[str, SentDrive], truthful: Outcome) -> None:
    attacked = play(drives, ATTACKS[name])

    assert attacked.accepted == 12
    assert same(attacked, truthful)
