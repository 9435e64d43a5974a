"""What reaches a terminal, a page or a log is drawn and never obeyed."""

from __future__ import annotations

import contextlib
import io
import json
import unicodedata

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rse_pf.errors import CommandFailed
from rse_pf.terminal import (
    at_work,
    counted,
    error_lines,
    json_line,
    printable,
    show,
    show_error,
    show_progress,
)

OBEYED = {"Cc", "Cf", "Cs", "Co", "Zl", "Zp"}
encode = msgspec.json.Encoder().encode


def obeyed(text: str) -> list[str]:
    """Return the characters of *text* that are not simply drawn."""
    return [letter for letter in text if unicodedata.category(letter) in OBEYED]


@pytest.mark.parametrize(
    ("hostile", "escaped"),
    [
        ("\x1b[2J", r"\x1b[2J"),
        ("\x1b]52;c;cm0gLXJm\x07", r"\x1b]52;c;cm0gLXJm\x07"),
        ("ok\r\nforged", r"ok\r\nforged"),
        ("\x9b31m\x7f\x00", r"\x9b31m\x7f\x00"),
        ("\u202etxt.exe\u2066\u200f", r"\u202etxt.exe\u2066\u200f"),
        ("robot\u200b-1\ufeff\u00ad\u034f\ufe0f\u3164", r"robot\u200b-1\ufeff\xad\u034f\ufe0f\u3164"),
        ("a\u2028b\u2029c\x85d", r"a\u2028b\u2029c\x85d"),
        ("\udc80\ud800", r"\udc80\ud800"),
        ("\U000e0041\U000f0000", r"\U000e0041\U000f0000"),
    ],
)
def test_what_a_terminal_would_obey_or_hide_is_escaped(hostile: str, escaped: str) -> None:
    assert printable(hostile) == escaped


@pytest.mark.parametrize(
    "text",
    [
        "robot-1",
        "Küche",
        "厨房 三",
        "кухня",
        "مطبخ",
        "रसोई",
        "ครัว",
        "부엌",
        "e\u0301",
        "π ≈ 3, 20 °C",
        "\\x1b",
    ],
)
def test_text_of_every_language_stays(text: str) -> None:
    assert printable(text) == text


@given(st.dictionaries(st.text(), st.text(st.characters()), max_size=3))
def test_a_line_of_a_log_holds_no_control_byte_and_reads_as_what_was_logged(fields: dict[str, str]) -> None:
    line = json_line(fields, encode)

    assert obeyed(line.decode()) == []
    assert json.loads(line) == fields


def test_a_message_of_several_lines_cannot_pass_for_two_reports(capsys: pytest.CaptureFixture[str]) -> None:
    error = CommandFailed("cmake failed:\nUsageError: x\n\x1b[A", hint="fix\nit")

    show_error(error)

    lines = ["CommandFailed: cmake failed:", "  | UsageError: x", r"  | \x1b[A", r"  hint: fix\nit"]
    assert capsys.readouterr().err.splitlines() == lines
    assert error_lines(CommandFailed("short", hint="do this")) == [
        "CommandFailed: short",
        "  hint: do this",
    ]


def test_an_error_without_a_hint_names_where_it_is_explained() -> None:
    assert error_lines(CommandFailed("short")) == [
        "CommandFailed: short",
        "  see: docs/errors.md#failed, or run: rse-pf errors failed",
    ]


@pytest.mark.parametrize(
    ("number", "noun", "text"),
    [
        (0, "robot", "0 robots"),
        (1, "robot", "1 robot"),
        (2, "robot", "2 robots"),
        (1200, "point", "1200 points"),
    ],
)
def test_a_number_and_its_noun_agree(number: int, noun: str, text: str) -> None:
    assert counted(number, noun) == text


def test_a_terminal_without_the_letters_gets_their_escapes(monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(written, encoding="latin-1"))

    show("Küche 厨房")

    assert written.getvalue() == "Küche \\u53a8\\u623f\n".encode("latin-1")


@pytest.mark.parametrize("is_terminal", [True, False])
def test_progress_rewrites_a_line_of_a_terminal_only(
    is_terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: is_terminal, raising=False)
    monkeypatch.setattr("sys.stderr", screen)

    show_progress("50 %\n\x1b", is_over=False)
    show_progress("done", is_over=True)

    assert screen.getvalue() == ("\r\033[K50 %\\n\\x1b\r\033[Kdone\n" if is_terminal else "")


@pytest.mark.parametrize("fails", [True, False])
def test_what_is_at_work_is_shown_until_its_end(fails: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: True, raising=False)
    monkeypatch.setattr("sys.stderr", screen)

    with contextlib.suppress(ValueError), at_work("drawing the map"):
        if fails:
            raise ValueError

    assert screen.getvalue() == "\r\033[Kdrawing the map ...\r\033[K"
