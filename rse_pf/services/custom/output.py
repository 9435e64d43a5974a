"""Split the printed output of a service into log lines of limited length and rate.

Bytes arrive as the pipe of a sandbox delivers them; a line is complete at its newline, or when the service
ends.  This module neither reads nor writes, and the time is an argument.
"""

from __future__ import annotations

import codecs
import time
from collections.abc import Iterator

from rse_pf.limits.token_bucket import TokenBucket

__all__ = ["MAX_LINE", "OutputLines", "format_output_line"]

MAX_LINE = 256  # longest line of output in characters, as long as a line of the log; a longer one is cut
_MARK_CHARACTERS = 40  # characters of a cut line that are reserved for the mark "[N characters more]"
_LINES_PER_S = 50.0  # lines per second that pass in the long run, so that one service cannot fill the log
_BURST_LINES = 200.0  # lines that pass at once, such as a traceback, after a time without output


class OutputLines:
    """Splits the output of one sandbox into lines.

    A token bucket lets 200 lines pass at once and 50 per second in the long run; other lines are dropped.
    After lines were dropped, a line with their number precedes the next line that passes.  A line of more
    than `MAX_LINE` characters is cut, and ends with the number of characters that are missing.  `feed` and
    `end` are generators, which the caller must exhaust: they change the state while they yield.
    """

    def __init__(self) -> None:
        """Start without output."""
        self._decode = codecs.getincrementaldecoder("utf-8")("replace").decode
        self._bucket = TokenBucket(_LINES_PER_S, _BURST_LINES)
        self._line = ""  # start of the incomplete line, at most MAX_LINE characters
        self._line_characters = 0  # characters of the incomplete line
        self._dropped = 0  # lines dropped since the last line that passed

    def feed(self, data: bytes, now: float) -> Iterator[str]:
        """Yield the lines that *data* completes at *now* (s, monotonic) and the rate limit lets pass."""
        *complete_lines, rest = self._decode(data).split("\n")
        for text in complete_lines:
            self._extend(text)
            yield from self._complete(now)
        self._extend(rest)

    def end(self, now: float) -> Iterator[str]:
        """Yield a last line without newline, and the number of dropped lines, after the service has ended."""
        self._extend(self._decode(b"", True))
        if self._line_characters:
            yield from self._complete(now)
        yield from self._report_dropped()

    def _extend(self, text: str) -> None:
        self._line += text[: max(0, MAX_LINE - len(self._line))]
        self._line_characters += len(text)

    def _complete(self, now: float) -> Iterator[str]:
        line, characters = self._line, self._line_characters
        self._line, self._line_characters = "", 0
        if self._bucket.take(now) > 0:
            self._dropped += 1
            return
        yield from self._report_dropped()
        yield (line if characters <= MAX_LINE else _cut(line, characters)).removesuffix("\r")

    def _report_dropped(self) -> Iterator[str]:
        if self._dropped:
            lines = "line was" if self._dropped == 1 else "lines were"
            yield f"[{self._dropped} {lines} left out here: the service printed too fast]"
            self._dropped = 0


def format_output_line(time_s: float, robot: str, text: str) -> str:
    """Return a line for a terminal: local time of *time_s* (Unix), *robot*, and printed *text*."""
    clock = time.strftime("%H:%M:%S", time.localtime(time_s))
    return f"{clock}.{int(time_s % 1 * 1e3):03d}  {robot}  | {text}"


def _cut(line: str, characters: int) -> str:
    shown = MAX_LINE - _MARK_CHARACTERS
    return f"{line[:shown]} [{characters - shown} characters more]"
