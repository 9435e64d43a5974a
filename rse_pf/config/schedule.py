"""The least number of servers by day and time: "weekdays 08:00 min 4; weekdays 18:00 min 1".

Pure functions: the text becomes entries, and entries give the minimum that holds at a time of day.  The
stacks write the same entries as scheduled actions of the Auto Scaling group.
"""

from __future__ import annotations

import dataclasses
import re
import zoneinfo
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone, tzinfo

from rse_pf.errors import SettingsError

__all__ = ["DAYS", "ScheduleEntry", "minimum_at", "parse_schedule", "resuming", "zone_named"]

DAYS = ("sun", "mon", "tue", "wed", "thu", "fri", "sat")
"""Names of the days; the index is the number of the day in cron."""

_SETS = {"daily": range(7), "weekdays": range(1, 6), "weekends": (0, 6)}
_ENTRY = re.compile(r"([a-z,-]+)\s+(\d{1,2}):(\d{2})\s+min\s+(\d{1,4})")
_ZONE = re.compile(r"[A-Za-z][A-Za-z0-9_+-]*(?:/[A-Za-z0-9_+-]+)*")
_SURELY_KNOWN = "Europe/London"
_WEEK_DAYS = 7
_HINT = 'write it as "weekdays 08:00 min 4; weekdays 18:00 min 1; sat,sun 10:00 min 2"'


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduleEntry:
    """Least number of servers from *hour*:*minute* on each of *days*, which are as in cron (0 is Sunday)."""

    days: tuple[int, ...]
    hour: int
    minute: int
    min_servers: int


def parse_schedule(text: str, name: str = "scaling.schedule") -> tuple[ScheduleEntry, ...]:
    """Return the entries of *text*, in its order; none if it is empty.

    Raises:
        SettingsError: The text is malformed, or two entries begin at the same minute.
    """
    entries = tuple(_entry(part.strip(), name) for part in text.split(";") if part.strip())
    begins = [(day, each.hour, each.minute) for each in entries for day in each.days]
    twice = next((begin for begin in begins if begins.count(begin) > 1), None)
    if twice is not None:
        day, hour, minute = twice
        raise SettingsError(
            f"{name} has two entries for {DAYS[day]} {hour:02d}:{minute:02d}", hint="leave one of them out"
        )
    return entries


def minimum_at(entries: Sequence[ScheduleEntry], local: datetime, *, otherwise: int) -> int:
    """Return the least number of servers at *local*, a time in the schedule's zone.

    The entry that began last holds, that of a week ago included; *otherwise* if there is no entry.
    """
    return _minimum(entries, _minute(int(local.strftime("%w")), local.hour, local.minute), otherwise)


def resuming(entries: Sequence[ScheduleEntry]) -> tuple[ScheduleEntry, ...]:
    """Return the entries that resume a parked platform, each on those of its days on which it does.

    These do not lower the minimum: the one in the morning wants servers, and the one in the evening fewer.
    """
    found = (
        dataclasses.replace(
            each,
            days=tuple(
                day
                for day in each.days
                if each.min_servers >= _minimum(entries, _minute(day, each.hour, each.minute) - 1, 0)
            ),
        )
        for each in entries
    )
    return tuple(each for each in found if each.days)


def zone_named(name: str) -> tzinfo:
    """Return the time zone *name*, such as ``Asia/Seoul``.

    Raises:
        SettingsError: There is no such zone.
    """
    if name == "UTC":
        return timezone.utc
    hint = "write it as Asia/Seoul, Europe/Berlin or UTC"
    if _ZONE.fullmatch(name) is None:
        raise SettingsError(f"scaling.time_zone = {name!r} is no time zone", hint=hint)
    try:
        return zoneinfo.ZoneInfo(name)
    except (zoneinfo.ZoneInfoNotFoundError, OSError, ValueError):
        if not _has_zones():
            return timezone(timedelta(0), name)  # this machine has no list of zones; the stacks' machine has
        raise SettingsError(f"scaling.time_zone = {name!r} is no time zone", hint=hint) from None


def _has_zones() -> bool:
    try:
        zoneinfo.ZoneInfo(_SURELY_KNOWN)
    except (zoneinfo.ZoneInfoNotFoundError, OSError):
        return False
    return True


def _entry(text: str, name: str) -> ScheduleEntry:
    found = _ENTRY.fullmatch(text.lower())
    if found is None:
        raise SettingsError(f"{name} has {_shown(text)}, which is no entry of a schedule", hint=_HINT)
    days, hour, minute, least = found.groups()
    if int(hour) > 23 or int(minute) > 59:
        raise SettingsError(f"{name} has {hour}:{minute}, which is no time of day", hint=_HINT)
    entry = ScheduleEntry(
        days=_days(days, name),
        hour=int(hour),
        minute=int(minute),
        min_servers=int(least),
    )
    if entry.min_servers < 1:
        raise SettingsError(f"{name} has min 0; a server is needed", hint="write min 1 or more")
    return entry


def _days(text: str, name: str) -> tuple[int, ...]:
    """Return the numbers of the days in such a text as ``mon-fri`` or ``sat,sun``, sorted."""
    if text in _SETS:
        return tuple(_SETS[text])
    chosen: set[int] = set()
    for part in text.split(","):
        first, _, last = part.partition("-")
        last = last or first
        if first not in DAYS or last not in DAYS:
            raise SettingsError(
                f"{name} has the days {_shown(text)}; known are {', '.join((*_SETS, *DAYS))}", hint=_HINT
            )
        at, end = DAYS.index(first), DAYS.index(last)
        chosen |= {(at + step) % _WEEK_DAYS for step in range((end - at) % _WEEK_DAYS + 1)}
    return tuple(sorted(chosen))


def _minimum(entries: Sequence[ScheduleEntry], minute_of_week: int, otherwise: int) -> int:
    week = _minute(_WEEK_DAYS, 0, 0)
    begun = [
        ((minute_of_week - _minute(day, each.hour, each.minute)) % week, each.min_servers)
        for each in entries
        for day in each.days
    ]
    return min(begun)[1] if begun else otherwise


def _minute(day: int, hour: int, minute: int) -> int:
    return (day * 24 + hour) * 60 + minute


def _shown(text: str) -> str:
    return repr(text if len(text) <= 60 else f"{text[:57]}...")
