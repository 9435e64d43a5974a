"""The least number of servers by day and time: "weekdays 08:00 min 4; weekdays 18:00 min 1".

The functions are pure: `parse_schedule` converts the text to entries, and `minimum_at` returns the minimum
that the entries define for a time.  The stacks deploy the same entries as scheduled actions of the Auto
Scaling group.
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
"""Names of the days of the week; the index of a name is the number of the day in cron."""

# Words of a schedule for several days: their numbers in cron.
_SETS = {"daily": range(7), "weekdays": range(1, 6), "weekends": (0, 6)}
# One entry of a schedule: days, hour, minute, minimum number of servers.
_ENTRY = re.compile(r"([a-z,-]+)\s+(\d{1,2}):(\d{2})\s+min\s+(\d{1,4})")
# The form of the name of a time zone; no other text is used to look for a file.
_ZONE = re.compile(r"[A-Za-z][A-Za-z0-9_+-]*(?:/[A-Za-z0-9_+-]+)*")
# A time zone that each time zone database has: if it is missing, this machine has no database.
_SURELY_KNOWN = "Europe/London"
_WEEK_DAYS = 7
_HINT = 'write it as "weekdays 08:00 min 4; weekdays 18:00 min 1; sat,sun 10:00 min 2"'


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduleEntry:
    """Minimum number of servers from *hour*:*minute* on each of *days* until the next entry begins.

    *days* are numbers as in cron: 0 is Sunday, 6 is Saturday.
    """

    days: tuple[int, ...]
    hour: int
    minute: int
    min_servers: int


def parse_schedule(text: str, name: str = "scaling.schedule") -> tuple[ScheduleEntry, ...]:
    """Return the entries of a schedule in the order of *text*; an empty tuple for an empty text.

    Args:
        text: Entries such as ``weekdays 08:00 min 4``, separated by semicolons.
        name: Name of the setting, for the messages of errors.

    Raises:
        SettingsError: The text is malformed, or two entries begin at the same minute of the week.
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
    """Return the minimum number of servers at *local*, a time in the time zone of the schedule.

    It is that of the entry that began last, up to a week before *local*.  Without entries, *otherwise* is
    returned.
    """
    return _minimum(entries, _minute(int(local.strftime("%w")), local.hour, local.minute), otherwise)


def resuming(entries: Sequence[ScheduleEntry]) -> tuple[ScheduleEntry, ...]:
    """Return the entries that resume a parked platform, each reduced to the days on which it does.

    An entry resumes the platform on a day if its minimum is not below the one that holds just before it: the
    entry of a morning, which asks for servers, but not the entry of an evening, which asks for fewer.
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

    On a machine without a time zone database, the result for a name that may be valid is a zone of this name
    with the offset of UTC.

    Raises:
        SettingsError: The name has a wrong form, or the database of this machine has no such time zone.
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
            return timezone(timedelta(0), name)  # the machine that deploys the stacks checks the name
        raise SettingsError(f"scaling.time_zone = {name!r} is no time zone", hint=hint) from None


def _has_zones() -> bool:
    """Return whether this machine has a time zone database."""
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
    """Return the sorted numbers of the days that *text* names, such as ``mon-fri``, ``sat,sun`` or ``daily``.

    *name* is the name of the setting, for the messages of errors.
    """
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
    """Return the minimum of the entry that began last at *minute_of_week*; *otherwise* without entries."""
    week = _minute(_WEEK_DAYS, 0, 0)
    begun = [
        ((minute_of_week - _minute(day, each.hour, each.minute)) % week, each.min_servers)
        for each in entries
        for day in each.days
    ]
    return min(begun)[1] if begun else otherwise


def _minute(day: int, hour: int, minute: int) -> int:
    """Return the minute of the week, from Sunday 00:00 on."""
    return (day * 24 + hour) * 60 + minute


def _shown(text: str) -> str:
    return repr(text if len(text) <= 60 else f"{text[:57]}...")
