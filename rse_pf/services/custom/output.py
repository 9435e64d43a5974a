"""What a service prints, as lines of bounded length and number, none of which is lost in between.

Bytes arrive as the pipe delivers them: a line is complete with its newline, or with the end of the service.
Nothing is read or written here, and the time is an argument.
"""

from __future__ import annotations

import codecs
import time
from collections.abc import Iterator

from rse_pf.token_bucket import TokenBucket

__all__ = ["MAX_LINE", "OutputLines", "shown_output"]

MAX_LINE = 256
"""Letters of a line, its mark included: what a line of the log holds."""
_MARK_LETTERS = 40
_LINES_PER_S = 50.0
_BURST_LINES = 200.0


class OutputLines:
    """Splits the output of one sandbox into lines.

    At most 200 lines at once and 50 a second pass; the number of the others is told in a line of its own.  A
    line of more than `MAX_LINE` letters is cut, and a mark says how many letters are missing.
    """

    def __init__(self) -> None:
        """Begin with no output."""
        self._decode = codecs.getincrementaldecoder("utf-8")("replace").decode
        self._bucket = TokenBucket(_LINES_PER_S, _BURST_LINES)
        self._begun = ""
        self._begun_letters = 0
        self._left_out = 0

    def feed(self, data: bytes, now: float) -> Iterator[str]:
        """Yield the lines that *data* completes at *now* (s, monotonic)."""
        *whole, rest = self._decode(data).split("\n")
        for text in whole:
            self._extend(text)
            yield from self._complete(now)
        self._extend(rest)

    def end(self, now: float) -> Iterator[str]:
        """Yield what is left at the end: a line without a newline, and the number of lines left out."""
        self._extend(self._decode(b"", True))
        if self._begun_letters:
            yield from self._complete(now)
        yield from self._told()

    def _extend(self, text: str) -> None:
        self._begun += text[: max(0, MAX_LINE - len(self._begun))]
        self._begun_letters += len(text)

    def _complete(self, now: float) -> Iterator[str]:
        line, letters = self._begun, self._begun_letters
        self._begun, self._begun_letters = "", 0
        if self._bucket.take(now) > 0:
            self._left_out += 1
            return
        yield from self._told()
        yield (line if letters <= MAX_LINE else _cut(line, letters)).removesuffix("\r")

    def _told(self) -> Iterator[str]:
        if self._left_out:
            lines = "line was" if self._left_out == 1 else "lines were"
            yield f"[{self._left_out} {lines} left out here: the service printed too fast]"
            self._left_out = 0


def shown_output(time_s: float, robot: str, text: str) -> str:
    """Return a line of output for a person: local time of *time_s* (Unix), robot, and *text*."""
    clock = time.strftime("%H:%M:%S", time.localtime(time_s))
    return f"{clock}.{int(time_s % 1 * 1e3):03d}  {robot}  | {text}"


def _cut(line: str, letters: int) -> str:
    kept = MAX_LINE - _MARK_LETTERS
    return f"{line[:kept]} [{letters - kept} letters more]"
