"""Write text to a terminal, a page or a log, and escape hidden characters, which a robot may have sent.

Names, notes, provenance, answers of services and messages of errors may come from a robot.  A control
character in them would move the cursor, change the clipboard or forge a line; an override of the writing
direction, or an invisible character, would make one name look like another.  Commands write only through
`show`, and logs only through `json_line`, so that no caller has to know where a text comes from.  Letters of
every language stay as they are.

Source:
    The Unicode Standard 15, Sect. 4.5 (general categories) and 5.21 (characters that are ignored in display);
    Boucher and Anderson, "Trojan Source", 2021.
"""

from __future__ import annotations

import json
import re
import sys
import time
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from rse_pf.errors import RsePfError

__all__ = [
    "at_work",
    "counted",
    "error_lines",
    "format_time",
    "json_line",
    "printable",
    "show",
    "show_error",
    "show_json",
    "show_page",
    "show_progress",
]

# Unicode categories of characters that are escaped: control, format, surrogate, private use, unassigned, line
# separator and paragraph separator.
_HIDDEN_CATEGORIES = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
# Letters, marks and symbols that are escaped because they are drawn as nothing; their category is another.
_INVISIBLE = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u2800\u3164\ufe00-\ufe0f\uffa0\U000e0000-\U000e0fff]"
)
# The escapes of these characters, in place of the numeric escapes \x0a, \x0d and \x09.
_SHORT = {"\n": r"\n", "\r": r"\r", "\t": r"\t"}
# A character that may need an escape: anything but printable ASCII.
_NOT_ASCII = re.compile(r"[^\x20-\x7e]")
# Begins the second and each further line of an error message, so that it cannot look like another report.
_CONTINUED = "  | "
# Moves the cursor of a terminal to the start of the line, and clears the line.
_CLEAR_LINE = "\r\033[K"


def printable(text: str) -> str:
    r"""Return *text* with an escape such as ``\x1b`` in place of each character that is not visible.

    Escaped are control, format, private, unassigned and invisible characters, surrogates, and all separators
    of lines, among them the newline.  The result contains no such character, so escaping it again changes
    nothing.
    """
    if text.isascii() and text.isprintable():
        return text
    return _NOT_ASCII.sub(_escape, text)


def counted(number: float, noun: str, plural: str = "") -> str:
    """Return *number* with *noun* in the singular or plural: ``1 robot``, ``2 robots``, ``0 entries``."""
    return f"{number:g} {noun}" if number == 1 else f"{number} {plural or f'{noun}s'}"


def format_time(time_s: float) -> str:
    """Return the Unix time *time_s* (seconds) as date and time in UTC, such as ``2024-05-01 12:00:00Z``."""
    return time.strftime("%Y-%m-%d %H:%M:%SZ", time.gmtime(time_s))


def show(*lines: str, error: bool = False) -> None:
    """Write each of *lines* as one line to standard output; hidden characters are escaped by `printable`.

    Args:
        *lines: The lines without a newline at their end; a newline inside a line is escaped, too.
        error: Whether to write to standard error instead.
    """
    _write(sys.stderr if error else sys.stdout, "".join(f"{printable(line)}\n" for line in lines))


def show_page(text: str) -> None:
    """Write *text* of several lines to standard output, each line as by `show`.

    The line breaks of *text* are kept, so a text that a robot sent must not be part of it unescaped.
    """
    show(*text.removesuffix("\n").split("\n"))


def show_json(value: Any, *, indent: int | None = None, sort_keys: bool = False) -> None:
    """Write *value* to standard output as JSON in ASCII; values that JSON cannot hold are written as text."""
    _write(sys.stdout, json.dumps(value, indent=indent, sort_keys=sort_keys, default=str) + "\n")


def show_error(error: RsePfError) -> None:
    """Write the message and the hint of *error* to standard error."""
    show(*error_lines(error), error=True)


def error_lines(error: RsePfError) -> list[str]:
    """Return the lines that report *error* to a user: class and message, then the hint.

    Without a hint, the last line is the address of the explanation.  The second and each further line of a
    message begin with `_CONTINUED`, so that a message cannot imitate another report.
    """
    first = f"{type(error).__name__}: {error.message}".rstrip("\n").replace("\n", f"\n{_CONTINUED}")
    return [*first.split("\n"), f"  hint: {error.hint}" if error.hint else f"  see: {error.address()}"]


def show_progress(text: str, *, is_over: bool) -> bool:
    """Replace the current line of standard error by *text*, if standard error is a terminal.

    With *is_over* a newline follows, so that the next call writes a new line.  Returns whether standard error
    is a terminal; nothing is written to a file or a pipe.
    """
    if not sys.stderr.isatty():
        return False
    end = "\n" if is_over else ""
    _write(sys.stderr, f"{_CLEAR_LINE}{printable(text)}{end}")
    return True


@contextmanager
def at_work(text: str) -> Iterator[None]:
    """Show *text* and "..." on the current line of a terminal while the body runs; then clear the line."""
    show_progress(f"{text} ...", is_over=False)
    try:
        yield
    finally:
        show_progress("", is_over=False)


def json_line(value: Any, encode: Callable[[Any], bytes]) -> bytes:
    """Return *value* as one line of JSON without a newline, with hidden characters as JSON escapes.

    Args:
        value: A value that JSON can hold.
        encode: Returns the JSON of a value in UTF-8.  It is an argument so that this module, which every
            command imports, need not import an encoder.
    """
    try:
        line = encode(value)
    except UnicodeEncodeError:  # *value* has a lone surrogate, which UTF-8 cannot encode
        return json.dumps(value, default=str).encode()
    if line.isascii() and b"\x7f" not in line:
        return line
    return _NOT_ASCII.sub(_escape_in_json, line.decode()).encode()


def _escape(match: re.Match[str]) -> str:
    letter, code = match[0], ord(match[0])
    if not _is_hidden(letter):
        return letter
    form = "\\x{:02x}" if code < 0x100 else "\\u{:04x}" if code < 0x10000 else "\\U{:08x}"
    return _SHORT.get(letter) or form.format(code)


def _escape_in_json(match: re.Match[str]) -> str:
    return json.dumps(match[0])[1:-1] if _is_hidden(match[0]) else match[0]


def _is_hidden(letter: str) -> bool:
    return unicodedata.category(letter) in _HIDDEN_CATEGORIES or _INVISIBLE.match(letter) is not None


def _write(stream: TextIO, text: str) -> None:
    try:
        stream.write(text)
    except UnicodeEncodeError:  # the terminal's encoding lacks a letter, which is written as an escape
        encoding = stream.encoding or "ascii"
        stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
    stream.flush()
