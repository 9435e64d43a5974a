"""Measure how often the explanation of a bad pose names the cause that was planted.

Defends: ten causes at three severities each, the right one named first in >= 26 of 30; >= 95 of 100 healthy
commands told as healthy; <= 200 ms a command.  The order of cases is shuffled, `explain` sees none of the
labels, and the answers are compared only when all are given.  Thresholds were chosen on
seeds below 100 and the first half of the red kitchen, and corrected once after seeds 1000 to 1130, which took
its second half and fr1; report seeds from 2000 on.

    python -m benchmarks recording.causes --recordings ../shared/data --seed 2000 --rounds 1 --out causes.json
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.frame.registry import Bar, benchmark
from benchmarks.frame.report import say
from benchmarks.frame.statistics import spread
from benchmarks.recording.planted_causes import (
    PLANTED,
    RecordedCase,
    Sequence,
    healthy_case,
    load_sequence,
    plant_case,
    render_sequence,
)
from rse_pf.recording.explain import Cause, PoseExplanation, explain

__all__ = []

_FIRST_OF_SECOND_HALF, _FIRST_REPORTED_SEED = 1000, 2000
_SEVERITIES = (1, 2, 3)
# A healthy command's pose is correct by the limits that the other benchmarks use.
_CORRECT_M, _CORRECT_DEG = 0.1, 2.0
Label = tuple[Cause, int]


def sequence_of(seed: int, recordings: Path | None) -> Sequence:
    """Return the sequence of *seed*: rendered, or where there are recordings every other one real."""
    if recordings is None or seed % 2 == 0:
        return render_sequence(seed)
    is_report = seed >= _FIRST_OF_SECOND_HALF
    if is_report and seed % 10 == 1:
        return load_sequence(recordings / "tum_fr1_xyz_start", seed, share=(0.0, 1.0))
    return load_sequence(
        recordings / "7scenes_redkitchen", seed, share=(0.5, 1.0) if is_report else (0.0, 0.5)
    )


def cases_of(
    seed: int, rounds: int, healthy: int, recordings: Path | None, only: Cause | None
) -> list[tuple[Label, RecordedCase]]:
    """Return labelled cases in random order, each of a seed of its own."""
    cases: list[tuple[Label, RecordedCase]] = []
    labels: list[Label] = [
        (cause, severity) for _ in range(rounds) for cause in PLANTED for severity in _SEVERITIES
    ]
    for cause, severity in labels:
        seed += 1
        if only in (None, cause):
            cases.append(
                ((cause, severity), plant_case(sequence_of(seed, recordings), seed, cause, severity))
            )
    wanted = len(cases) + (healthy if only in (None, Cause.NONE) else 0)
    while len(cases) < wanted:
        seed += 1
        case = healthy_case(sequence_of(seed, recordings), seed)
        if case.error_m < _CORRECT_M and case.error_deg < _CORRECT_DEG:
            cases.append(((Cause.NONE, 0), case))
    order = np.random.default_rng(seed).permutation(len(cases))
    return [cases[k] for k in order]


def answers_of(cases: list[RecordedCase]) -> tuple[list[list[PoseExplanation]], list[float]]:
    """Return the explanations of *cases*, which hold no labels, and the CPU of each in ms."""
    answers, spent_ms = [], []
    for case in cases:
        begin = time.thread_time_ns()
        answers.append(explain(
            case.query, case.reply, thumbnail=case.thumbnail, history=case.history, timing=case.timing,
            T_odom_camera=case.T_odom_camera,
        ))  # fmt: skip
        spent_ms.append((time.thread_time_ns() - begin) / 1e6)
    return answers, spent_ms


def report_of(cases: list[tuple[Label, RecordedCase]], verbose: bool) -> dict[str, Any]:
    """Explain all cases, then compare with the labels."""
    answers, spent_ms = answers_of([case for _, case in cases])
    right: Counter[Label] = Counter()
    total: Counter[Label] = Counter()
    wrong = []
    for (label, case), given in zip(cases, answers, strict=True):
        total[label] += 1
        if given[0].cause is label[0]:
            right[label] += 1
        else:
            wrong.append({
                "planted": label[0].value, "severity": label[1], "kind": case.kind, "origin": case.origin,
                "named": [explanation.cause.value for explanation in given], "said": given[0].sentence,
                "error_m": round(min(case.error_m, 99.0), 3),
                "error_deg": round(min(case.error_deg, 180.0), 2),
            })  # fmt: skip
        if verbose:
            mark = "right" if given[0].cause is label[0] else "WRONG"
            what = f"{label[0].value} {label[1]} ({case.kind}; {case.origin}; off {case.error_m:.3f} m)"

            say(f"{mark} {what}")
            for explanation in given:
                say(f"      {explanation.cause.value} {explanation.confidence:.2f}: {explanation.sentence}")
    planted = [label for label in total if label[0] is not Cause.NONE]
    return {
        "planted": sum(total[label] for label in planted),
        "planted_right": sum(right[label] for label in planted),
        "healthy": total[(Cause.NONE, 0)], "healthy_right": right[(Cause.NONE, 0)],
        "by_cause": {
            cause.value: [f"{right[(cause, s)]}/{total[(cause, s)]}" for s in _SEVERITIES]
            for cause in PLANTED
        },
        "explain_cpu_ms": spread(spent_ms),
        "wrong": wrong,
    }  # fmt: skip


@benchmark(
    Bar("planted_right_percent", at_least=100 * 26 / 30, unit="%"),
    Bar("healthy_right_percent", at_least=95, unit="%"),
    Bar("explain_cpu_ms.max", at_most=200, unit="ms"),
)
def run_benchmark(
    *,
    recordings: Annotated[Path | None, "folder of recordings; without it all is rendered"] = None,
    seed: int = _FIRST_REPORTED_SEED,
    rounds: Annotated[int, "how often the 30 planted cases, with other seeds"] = 1,
    healthy: int = 100,
    only: Annotated[Cause | None, "one cause, or none for healthy commands only"] = None,
    verbose: Annotated[bool, "print every case"] = False,
) -> dict[str, Any]:
    """Explain the cases, and count."""
    figures = report_of(cases_of(seed, rounds, healthy, recordings, only), verbose)
    for kind in ("planted", "healthy"):
        if figures[kind]:
            figures[f"{kind}_right_percent"] = 100 * figures[f"{kind}_right"] / figures[kind]
    return figures
