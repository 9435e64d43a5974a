"""What a replay does with a recording: list what went wrong, solve everything again, report one command."""

from __future__ import annotations

import dataclasses
import heapq
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec

from rse_pf.config import PlatformSettings, PnpSettings
from rse_pf.errors import RsePfError
from rse_pf.extensions.recording.reader import RecordedCommand, open_recording
from rse_pf.extensions.recording.replay.report import CommandReport, report_of
from rse_pf.extensions.recording.replay.solving import Overrides, Resolver
from rse_pf.extensions.recording.replay.troubles import KINDS, RobotHistory, Trouble
from rse_pf.extensions.recording.summary import Wanted

__all__ = ["Changed", "Overview", "find", "overview", "report"]

_MAX_ROBOTS = 10_000
_MAX_CHANGED = 1000
_MAX_RESOLVERS = 16
_NEAR_S = 5.0
_LONGEST_S = 10.0
"""Of a `pnp` command, from its arrival to its answer."""
_LATEST_S = 9e9


class Changed(msgspec.Struct, frozen=True, kw_only=True):
    """A command that was solved again with another answer."""

    id: str
    what: str


class Overview(msgspec.Struct, frozen=True, kw_only=True):
    """What is in a recording.

    Attributes:
        files: How many.
        cut: Names of files that end within a record, and are read up to there.
        commands: How many; ``robots`` and ``seconds`` say of whom, and over how long.
        equal: Solved again with the recorded bytes, but for times and places; 0 where nothing was solved.
        different: Solved again with others; the first of them are ``changed``.
        not_solved: Why others could not be solved again, and how many.
        troubles: What went wrong, worst first; ``by_kind`` counts all.
    """

    files: int
    cut: tuple[str, ...]
    version: str
    side: str
    commands: int
    robots: int
    seconds: float
    left_out: int
    equal: int = 0
    different: int = 0
    was_solved: bool = False
    changed: tuple[Changed, ...] = ()
    not_solved: dict[str, int] = {}
    troubles: tuple[Trouble, ...] = ()
    by_kind: dict[str, int] = {}


class _Worst:
    """The *count* worst troubles."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._heap: list[tuple[tuple[float, ...], int, Trouble]] = []
        self._added = 0

    def add(self, trouble: Trouble) -> None:
        self._added += 1
        mildness = tuple(-number for number in trouble.order)
        entry = mildness, -self._added, trouble
        if len(self._heap) < self._count:
            heapq.heappush(self._heap, entry)
        elif self._count:
            heapq.heappushpop(self._heap, entry)

    def sorted(self) -> tuple[Trouble, ...]:
        return tuple(entry[2] for entry in sorted(self._heap, key=lambda each: each[:2], reverse=True))


def overview(
    path: Path,
    settings: PlatformSettings,
    *,
    solve: bool,
    overrides: Overrides | None = None,
    worst: int = 20,
) -> Overview:
    """Return what is in the recording at *path*, and what went wrong.

    Args:
        path: A file or a folder.
        settings: The limits of messages; those of the solver are taken from the recording.
        solve: Whether to solve every command again.
        overrides: What to try instead of what was asked for.
        worst: How many troubles are told.

    Raises:
        RsePfError: The recording cannot be read, or *overrides* name an engine that is not there.
    """
    recording = open_recording(path, settings.session)
    resolvers = _Resolvers(settings)
    robots: dict[str, RobotHistory] = {}
    troubles = _Worst(worst)
    by_kind: Counter[str] = Counter()
    not_solved: Counter[str] = Counter()
    changed: list[Changed] = []
    commands = equal = different = 0
    first_s = last_s = None
    for command in recording.commands():
        commands += 1
        first_s = command.sent_s if first_s is None else min(first_s, command.sent_s)
        last_s = command.sent_s if last_s is None else max(last_s, command.sent_s)
        if command.robot not in robots and len(robots) >= _MAX_ROBOTS:
            robots.pop(next(iter(robots)))
        trouble = robots.setdefault(command.robot, RobotHistory()).judge(command)
        if trouble is not None:
            by_kind[trouble.kind] += 1
            troubles.add(trouble)
        if not solve:
            continue
        again = resolvers.of(command).again(command, overrides)
        if again.why_not or command.reply_bytes is None:
            not_solved[again.why_not or "no answer was recorded"] += 1
        elif again.is_equal:
            equal += 1
        else:
            different += 1
            if len(changed) < _MAX_CHANGED:
                changed.append(Changed(id=command.id, what=again.difference))
    return Overview(
        files=len(recording.files), cut=tuple(sorted({file.name for file in recording.cut})),
        version=recording.metadata.get("version", ""), side=recording.metadata.get("side", ""),
        commands=commands, robots=len(robots),
        seconds=0.0 if first_s is None or last_s is None else last_s - first_s, left_out=recording.left_out,
        equal=equal, different=different, was_solved=solve, changed=tuple(changed),
        not_solved=dict(not_solved.most_common(20)),
        by_kind={kind: by_kind[kind] for kind in KINDS if kind in by_kind},
        troubles=troubles.sorted(),
    )  # fmt: skip


def report(
    path: Path,
    settings: PlatformSettings,
    identity: str,
    overrides: Overrides | None = None,
    *,
    with_picture: bool = True,
) -> CommandReport:
    """Return all that is known about the command *identity*, as `WireRecording.find` takes it.

    Raises:
        RsePfError: The recording cannot be read, has no such command, or *overrides* name an engine that is
            not there.
    """
    recording = open_recording(path, settings.session)
    command = recording.find(identity)
    return report_of(command, _Resolvers(settings).of(command), overrides, with_picture=with_picture)


def find(
    path: Path,
    settings: PlatformSettings,
    *,
    trace: str,
    number: int,
    near_s: float | None = None,
    command_bytes: int | None = None,
) -> str:
    """Return ``CONNECTION:ID`` of a command that a server's log tells of, "" if there is none.

    Args:
        path: A file or a folder.
        settings: The limits of messages.
        trace: Of the command; many robots send none.
        number: Its id, which every connection counts on its own.
        near_s: When it was answered, Unix time: the nearest within 5 s is taken; None for the newest.
        command_bytes: The length of its message, None where it is not known.
    """
    nearest, nearest_s = "", _NEAR_S
    wanted = None
    if near_s is not None and 0.0 < near_s < _LATEST_S:
        begin_s, end_s = near_s - _NEAR_S - _LONGEST_S, near_s + _NEAR_S
        wanted = Wanted(begin_ns=round(1e9 * begin_s), end_ns=round(1e9 * end_s))
    for command in open_recording(path, settings.session).commands(wanted):
        if not command.id.endswith(f":{number}") or command_bytes not in (None, len(command.command_bytes)):
            continue
        answered_s = command.sent_s if command.answered_s is None else command.answered_s
        apart_s = 0.0 if near_s is None else abs(answered_s - near_s)
        if apart_s > nearest_s:
            continue
        try:
            if command.command.trace == trace:
                nearest, nearest_s = command.id, apart_s if near_s is not None else _NEAR_S
        except RsePfError:
            continue
    return nearest


class _Resolvers:
    """What solves with the numbers of the server that recorded, as far as its file says them."""

    def __init__(self, settings: PlatformSettings) -> None:
        self._settings = settings
        self._by_text: dict[str, Resolver] = {}

    def of(self, command: RecordedCommand) -> Resolver:
        text = command.about.get("pnp", "")
        if text not in self._by_text:
            if len(self._by_text) >= _MAX_RESOLVERS:
                self._by_text.clear()
            self._by_text[text] = Resolver(self._settings.replace(pnp=_pnp_settings(text)))
        return self._by_text[text]


def _pnp_settings(text: str) -> dict[str, Any]:
    """Return the settings of the solver that *text* says, the defaults where it says none."""
    defaults = dataclasses.asdict(PnpSettings())
    try:
        recorded = msgspec.json.decode(text, type=dict[str, Any])
        given = {name: value for name, value in recorded.items() if name in defaults}
        PlatformSettings().replace(pnp=given)
    except (msgspec.DecodeError, RsePfError, TypeError, ValueError):
        return defaults
    return {**defaults, **given}
