"""The frame of benchmarks: arguments from a function, bars on figures, pairs in turns."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest

from benchmarks.frame.registry import Benchmark, command_of, find, parser_of, run
from benchmarks.frame.report import Bar, judge
from benchmarks.frame.statistics import interleaved, median_ratio, percentile, spread

FIGURES = {"rows": [{"p99": 1.0}, {"p99": 3.0}], "lost": 0, "none": None, "named": {"a b": {"ok": True}}}


@pytest.mark.parametrize(
    ("bar", "value", "met"),
    [
        (Bar("rows.*.p99", at_most=2.0), 3.0, False),
        (Bar("rows.*.p99", at_least=1.0), 1.0, True),
        (Bar("rows.0.p99", at_most=2.0), 1.0, True),
        (Bar("lost", equals=0), 0, True),
        (Bar("named.*.ok", equals=True), True, True),
        (Bar("none", at_most=2.0), None, False),
        (Bar("not there", at_most=2.0), None, None),
    ],
)
def test_a_bar_judges_the_worst_figure(bar: Bar, value: object, met: bool | None) -> None:
    (judged,) = judge([bar], FIGURES)

    assert (judged["value"], judged["met"]) == (value, met)


def test_ways_take_turns_and_change_their_order() -> None:
    assert list(interleaved("ab", 3)) == [(0, "a"), (0, "b"), (1, "b"), (1, "a"), (2, "a"), (2, "b")]


def test_a_percentile_lies_between_two_values_and_is_nan_without_any() -> None:
    assert percentile([1.0, 2.0], 50) == 1.5
    assert math.isnan(percentile([], 99))
    assert spread(np.array([1.0, 3.0]))["p50"] == 2.0
    assert median_ratio([2.0, 3.0, 8.0], [1.0, 1.0, 1.0]) == 3.0


@dataclass(frozen=True, kw_only=True)
class Arguments:
    part: Annotated[str, "what", ("one", "two")]
    times: tuple[int, ...] = (1, 2)
    folder: Path | None = None
    is_short: bool = False


def measure(arguments: Arguments) -> dict[str, int]:
    return {"times": len(arguments.times)}


def test_the_fields_of_a_dataclass_are_the_arguments() -> None:
    parser = parser_of("x", Benchmark(measure, ()))

    given = parser.parse_args(["two", "--times", "3", "4", "5", "--is-short"])

    assert vars(given) == {"part": "two", "times": [3, 4, 5], "folder": None, "is_short": True, "out": None}


def test_a_list_that_has_a_default_may_be_given_without_values() -> None:
    given = parser_of("x", Benchmark(measure, ())).parse_args(["one", "--times", "--is-short"])

    assert given.times == []


def test_an_unknown_benchmark_is_one_line_with_a_hint(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["server.nothing"]) == 2
    assert "there is no benchmark 'server.nothing'" in capsys.readouterr().err


def test_a_function_is_called_in_a_process_of_its_own() -> None:
    assert command_of(find, "a")[2:] == [
        "import sys; from benchmarks.frame.registry import find; find(*sys.argv[1:])", "a"
    ]  # fmt: skip
