"""The replay of one command of the Poses view: it is found in the platform's recording and solved again.

The recording is read in a process with limits only (`rse_pf.extensions.recording.replay.limited`).
"""

from __future__ import annotations

import asyncio
import base64
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rse_pf.errors import BadRequest, Busy, NotFound
from rse_pf.local.state import platform_settings
from rse_pf.terminal import printable

if TYPE_CHECKING:
    from rse_pf.extensions.recording.replay.limited import LimitedReplay
    from rse_pf.extensions.recording.replay.report import CommandReport

__all__ = ["Replays", "replay_document"]

# Longest time until an answered command is written to the recording, in seconds.
_MAX_WRITE_DELAY_S = 2.0
# Largest image of a replay that is sent to the page, in bytes.
_MAX_PICTURE_BYTES = 2 << 20


class Replays:
    """Replays commands of one platform for the page, one at a time."""

    def __init__(self, folder: Path, *, wall_clock: Callable[[], float] = time.time) -> None:
        """Prepare replays of the platform whose state is in *folder*; no process is started yet."""
        self._folder = folder
        self._wall_clock = wall_clock
        self._replay: LimitedReplay | None = None
        self._lock = asyncio.Lock()

    async def page(self, query: Mapping[str, str]) -> tuple[str, bytes]:
        """Return media type and JSON of the replay of a command.

        *query* names the command by ``trace`` and ``id``; ``time_s`` (Unix) is the time of its answer and
        ``bytes`` its size, both of which help to find it.

        Raises:
            NotFound: The platform has no recording, or the command is not in it.
            Busy: Another replay is running.
            BadRequest: ``id`` or ``time_s`` is no number, or the recording cannot be read.
        """
        trace, identity, time_s = query.get("trace", ""), query.get("id", ""), query.get("time_s", "0")
        if not (identity.isascii() and identity.isdigit() and len(identity) < 17 and len(trace) <= 200):
            raise BadRequest("the id of the command is no number", hint="choose a line of the Poses view")
        try:
            answered_s = float(time_s[:20])
        except ValueError as error:
            raise BadRequest("the time of the command is no number", hint="choose a line") from error
        if self._lock.locked():
            raise Busy("another replay is under way", hint="try again in a moment", retry_after_ms=1000)
        async with self._lock:
            age_s = self._wall_clock() - answered_s
            if 0 <= age_s < _MAX_WRITE_DELAY_S:
                await asyncio.sleep(_MAX_WRITE_DELAY_S - age_s)
            size = query.get("bytes", "")
            command_bytes = int(size) if size.isascii() and size.isdigit() and len(size) < 10 else None
            reply = await asyncio.to_thread(
                self._replay_command, trace, int(identity), answered_s, command_bytes or None
            )
        return "application/json", json.dumps(reply).encode()

    def close(self) -> None:
        """Stop the process that reads the recording, if it runs."""
        if self._replay is not None:
            self._replay.close()

    def _replay_command(
        self, trace: str, identity: int, answered_s: float, command_bytes: int | None
    ) -> dict[str, Any]:
        from rse_pf.extensions.recording.replay.limited import LimitedReplay

        settings = platform_settings(self._folder)
        if settings is None or not settings.recording.folder:
            raise NotFound("this platform records nothing", hint="start it with: rse-pf local --record DIR")
        path = Path(settings.recording.folder)
        if self._replay is None:
            self._replay = LimitedReplay(settings)
        command = self._replay.find(
            path, trace=trace, id=identity, near_s=answered_s, command_bytes=command_bytes
        )
        if command is None:
            raise NotFound(
                "this command is not in the recording",
                hint="it was deleted with the oldest files, or its service is not recorded",
            )
        report = self._replay.command(path, command)
        return {"path": printable(str(path)), **replay_document(report)}


def replay_document(report: CommandReport) -> dict[str, Any]:
    """Return the members that the page shows of *report*: command, ``equal``, lines and picture.

    Texts are escaped.
    """
    picture = report.picture_png if len(report.picture_png) <= _MAX_PICTURE_BYTES else b""
    reason = f": {report.reason}" if report.reason else ""
    tried = (*report.engines, *report.options)
    lines = [
        f"verdict {report.verdict}{reason}; engine {report.engine or '-'}",
        f"{report.inliers} inliers of {report.matches} matches, {report.rmse_px:.2f} px",
        *(
            f"{rule.name}: {rule.about}: {f'{rule.measured:.4g} {rule.unit}'.rstrip()}, not "
            f"{'at least' if rule.at_least else 'at most'} {rule.limit:.4g}"
            for rule in report.rules
            if not rule.is_satisfied
        ),
        *(f"{attempt.name}: {attempt.verdict}, {attempt.inliers} inliers" for attempt in tried),
    ]
    if not report.is_equal and (report.why_not or report.difference):
        lines.insert(0, report.why_not or report.difference)
    return {
        "command": printable(report.id),
        "equal": report.is_equal,
        "lines": [printable(line) for line in lines],
        "picture": f"data:image/png;base64,{base64.b64encode(picture).decode()}" if picture else "",
    }
