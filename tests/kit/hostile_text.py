"""Text of a robot that would control the terminal which shows it, and what a terminal obeys in a text."""

from __future__ import annotations

import unicodedata

__all__ = ["HOSTILE", "obeyed"]

HOSTILE = (
    "r\x1b[2J\x1b]52;c;eA==\x07\x9b31m\u202e\u2066\u200b\ufeff\r\nok: forged\x85\u2028\x00\x7f\U000e0041"
)


def obeyed(text: str) -> set[str]:
    """Return what a terminal would obey or hide in *text*, apart from the newlines that end lines."""
    hidden = {"Cc", "Cf", "Cs", "Co", "Zl", "Zp"}
    return {letter for letter in text if unicodedata.category(letter) in hidden and letter != "\n"}
