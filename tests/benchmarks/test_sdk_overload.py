"""What clients offer in overload: what is counted, and options that have no effect."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.server.sdk_overload import Counted, run_benchmark
from rse_pf.errors import UsageError


def test_commands_are_counted_between_two_times_after_the_first() -> None:
    counted = Counted(came_s=[100.0, 104.9, 105.0, 107.0, 110.0], answered_s=[105.5, 111.0])

    assert counted.per_s(counted.came_s, 5.0, 10.0) == pytest.approx(2 / 5)
    assert counted.per_s(counted.answered_s, 5.0, 10.0) == pytest.approx(1 / 5)


@pytest.mark.parametrize(
    ("options", "hint"),
    [
        ({"obey": True}, "add --real"),
        ({"most": 500}, "add --real"),
        ({"real": True, "most": -3}, "name a number of robots, or 0"),
        ({"sdk": ("rust",)}, "choose of python, js, cpp"),
    ],
)
def test_an_option_without_effect_is_refused(options: dict[str, Any], hint: str) -> None:
    with pytest.raises(UsageError) as told:
        run_benchmark(**options)

    assert told.value.hint == hint
