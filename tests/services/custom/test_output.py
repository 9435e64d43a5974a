"""The output of a service becomes lines of limited length and rate."""

from __future__ import annotations

import pytest

from rse_pf.services.custom.output import MAX_LINE, OutputLines


def lines_of(*pieces: bytes, now: float = 0.0) -> list[str]:
    output = OutputLines()
    return [line for piece in pieces for line in output.feed(piece, now)] + list(output.end(now))


@pytest.mark.parametrize("size", [1, 2, 3, 7, 100])
def test_lines_are_the_same_however_the_pipe_cuts_them(size: int) -> None:
    data = "one\ntwo é €\n\n  last without a newline".encode()

    pieces = [data[start : start + size] for start in range(0, len(data), size)]

    assert lines_of(*pieces) == ["one", "two é €", "", "  last without a newline"]


def test_a_long_line_is_cut_and_says_how_much_is_missing() -> None:
    whole, cut = lines_of(b"x" * MAX_LINE + b"\n", b"y" * 100_000 + b"\n")

    assert whole == "x" * MAX_LINE
    assert len(cut) <= MAX_LINE
    kept = cut.count("y")
    assert cut.endswith(f"y [{100_000 - kept} characters more]")


def test_a_line_that_never_ends_takes_no_memory() -> None:
    output = OutputLines()
    for _ in range(100):
        assert list(output.feed(b"x" * 10_000, 0.0)) == []

    assert len(output._line) <= MAX_LINE


def test_lines_are_bounded_per_second_and_those_left_out_are_counted() -> None:
    output = OutputLines()

    first = list(output.feed(b"line\n" * 1000, 0.0))
    second = list(output.feed(b"later\n" * 1000, 1.0))

    assert first == ["line"] * 200
    assert second == ["[800 lines were left out here: the service printed too fast]"] + ["later"] * 50
    assert list(output.end(1.0)) == ["[950 lines were left out here: the service printed too fast]"]
