"""What counts as answered beyond the limit of a server, and when it has recovered."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.server.load import SAMPLE
from benchmarks.server.overload import AFTERWARDS_S, good, name_of, recovery_s, summary

OK, FAILED = 0, 1


def samples(*rows: tuple[float, float, int, int]) -> np.ndarray:
    made = np.zeros(len(rows), SAMPLE)
    for number, (planned_s, latency_s, group, outcome) in enumerate(rows):
        made[number] = (planned_s, latency_s, 0.0, group, outcome)
    return made


def test_a_pose_counts_if_it_came_within_the_deadline_of_its_planned_time() -> None:
    rows = samples(
        (1.0, 0.24, 0, OK), (1.1, 0.26, 0, OK), (1.2, 0.01, 0, FAILED), (1.3, np.nan, 0, 2),
        (1.4, 0.01, 1, OK), (0.9, 0.01, 0, OK), (2.0, 0.01, 0, OK),
    )  # fmt: skip

    assert good(rows, 1.0, 2.0).tolist() == [True, False, False, False]


@pytest.mark.parametrize(("served_from_s", "expected_s"), [(10.0, 0.0), (10.5, 0.5), (99.0, AFTERWARDS_S)])
def test_recovery_ends_when_nearly_all_are_served_again(served_from_s: float, expected_s: float) -> None:
    times = np.arange(10.0, 13.0, 0.01)
    rows = samples(*((t, 0.01, 0, OK if t >= served_from_s - 1e-6 else FAILED) for t in times))

    assert recovery_s(rows, 10.0) == pytest.approx(expected_s, abs=0.1)


def test_what_is_answered_is_compared_with_that_at_the_most() -> None:
    steps = [
        {"multiple": multiple, "answered_per_s": answered, "ping_p99_ms": 5.0, "recovery_s": recovery}
        for multiple, answered, recovery in (
            (1.0, 100.0, 9.0), (1.0, 200.0, 9.0), (1.0, 300.0, 9.0), (1.2, 150.0, 0.1), (1.5, 100.0, 0.4),
            (2.0, 50.0, 0.2), (3.0, 20.0, 0.3),
        )
    ]  # fmt: skip

    told = summary(steps)

    assert told["answered_percent"] == {"at_1_2": 75.0, "at_1_5": 50.0, "at_2": 25.0, "at_3": 10.0}
    assert (told["answered_per_s"], told["recovery_s"], name_of(1.5)) == (200.0, 0.4, "at_1_5")
