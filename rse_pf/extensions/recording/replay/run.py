"""The tasks of a replay: summarise a recording, report one command, and find a command of a log line."""

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

_MAX_ROBOTS = 10_000  # largest number of robots whose last commands are remembered: bounds the memory
_MAX_CHANGED = 1000  # largest number of commands with another answer that are listed
_MAX_RESOLVERS = 16  # largest number of solver settings for which a `Resolver` is kept
# Largest difference, seconds, between the time of a log line and the recorded time of the answer.
_MAX_TIME_DIFFERENCE_S = 5.0
_MAX_ROUND_TRIP_S = 10.0
"""Longest time, seconds, from the arrival of a `pnp` command to its answer."""
_MAX_TIME_S = 9e9  # largest Unix time, seconds, that nanoseconds of 63 bits can hold, rounded down


class Changed(msgspec.Struct, frozen=True, kw_only=True):
    """A command whose new answer differs from the recorded one: its ``CONNECTION:ID``, and what differs."""

    id: str
    what: str


class Overview(msgspec.Struct, frozen=True, kw_only=True):
    """The summary of a recording.

    Attributes:
        files: Number of files.
        cut: Names of truncated or damaged files, which were read up to the last complete chunk.
        version: Version of the software that recorded; "" if unknown.
        side: ``server`` or ``robot``, whichever recorded; "" if unknown.
        commands: Number of commands.
        robots: Number of robots that sent them, up to 10,000.
        seconds: Time from the first to the last command.
        left_out: Number of messages that could not be decoded.
        equal: Number of commands whose new answer has the recorded bytes except for `TIMES_AND_PLACES`.
        different: Number of commands with another new answer.
        was_solved: Whether the commands were solved again; else ``equal`` and ``different`` are 0.
        changed: The first 1000 commands with another new answer.
        not_solved: Number of the commands that could not be solved again, by reason (the 20 most frequent).
        troubles: What went wrong with commands, worst first, as many as were asked for.
        by_kind: Number of all troubles by kind.
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
    """Collects troubles, and keeps the worst *count* of them."""

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
    """Summarise the recording at *path*, and what went wrong with its commands.

    Args:
        path: A file or a folder of files.
        settings: Settings with the limits of messages; those of the solver are taken from the recording.
        solve: Whether to solve every command again.
        overrides: Options of the solver that replace the recorded ones; None for the recorded ones.
        worst: Largest number of troubles that are returned.

    Raises:
        RsePfError: The recording cannot be read, or *overrides* name an engine that is not installed.
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
        trouble = robots.setdefault(command.robot, RobotHistory()).classify(command)
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
    """Report the command *identity*, which is an id as `WireRecording.find` expects it.

    Args:
        path: A file or a folder of files.
        settings: Settings with the limits of messages; those of the solver are taken from the recording.
        identity: ``CONNECTION:ID``, or ``ID`` alone if it is unique.
        overrides: Options of the solver to try in addition; None for none.
        with_picture: Whether to draw the matches.

    Raises:
        RsePfError: The recording cannot be read, has no such command, or *overrides* name an engine that is
            not installed.
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
    """Return ``CONNECTION:ID`` of a command that a line of a server's log describes, "" if there is none.

    Args:
        path: A file or a folder of files.
        settings: Settings with the limits of messages.
        trace: Trace of the command, "" for a robot that sends none.
        number: Id of the command; other connections may have a command with the same id.
        near_s: Unix time of the answer; of several commands the one answered nearest to it, within 5 s, is
            returned.  None returns the newest one.
        command_bytes: Size of the message of the command; None if unknown.
    """
    nearest, nearest_s = "", _MAX_TIME_DIFFERENCE_S
    wanted = None
    if near_s is not None and 0.0 < near_s < _MAX_TIME_S:
        begin_s, end_s = near_s - _MAX_TIME_DIFFERENCE_S - _MAX_ROUND_TRIP_S, near_s + _MAX_TIME_DIFFERENCE_S
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
                nearest, nearest_s = command.id, apart_s if near_s is not None else _MAX_TIME_DIFFERENCE_S
        except RsePfError:
            continue
    return nearest


class _Resolvers:
    """Resolvers with the solver settings that the file of a command states, else with the defaults."""

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
    """Return the solver settings in the JSON *text*; defaults for missing ones, or if *text* is invalid."""
    defaults = dataclasses.asdict(PnpSettings())
    try:
        recorded = msgspec.json.decode(text, type=dict[str, Any])
        given = {name: value for name, value in recorded.items() if name in defaults}
        PlatformSettings().replace(pnp=given)
    except (msgspec.DecodeError, RsePfError, TypeError, ValueError):
        return defaults
    return {**defaults, **given}
