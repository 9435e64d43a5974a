"""What scaling.schedule means, and what of it and of the capacity is refused."""

from __future__ import annotations

from datetime import datetime
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.config.schedule import ScheduleEntry, minimum_at, parse_schedule, resuming, zone_named
from rse_pf.errors import SettingsError

OFFICE = parse_schedule("weekdays 08:00 min 4; weekdays 18:00 min 1; sat,sun 10:00 min 2")


def minimum(day: int, hour: int, minute: int = 0) -> int:
    """Return the minimum of `OFFICE` on such a day of November 2026; the 23rd is a Monday."""
    return minimum_at(OFFICE, datetime(2026, 11, day, hour, minute), otherwise=7)


def test_entries_name_days_time_and_limits() -> None:
    assert OFFICE[0] == ScheduleEntry(days=(1, 2, 3, 4, 5), hour=8, minute=0, min_servers=4)
    assert OFFICE[2] == ScheduleEntry(days=(0, 6), hour=10, minute=0, min_servers=2)
    assert parse_schedule(" Fri-Mon 7:05  min 1 ;")[0].days == (0, 1, 5, 6)
    assert parse_schedule("") == ()


def test_the_entry_that_began_last_holds() -> None:
    assert [minimum(23, 7, 59), minimum(23, 8), minimum(23, 17, 59), minimum(23, 18)] == [2, 4, 4, 1]


def test_a_weekend_goes_on_until_monday_morning() -> None:
    assert [minimum(28, 9), minimum(28, 10), minimum(29, 23), minimum(30, 7)] == [1, 2, 2, 2]


def test_without_a_schedule_the_settings_hold() -> None:
    assert minimum_at((), datetime(2026, 11, 23), otherwise=7) == 7


def test_a_time_zone_is_found_by_its_name() -> None:
    assert datetime(2026, 11, 23, tzinfo=zone_named("UTC")).utcoffset() is not None
    seoul = datetime(2026, 11, 23, tzinfo=zone_named("Asia/Seoul")).utcoffset()
    assert seoul is None or seoul.total_seconds() in (0, 9 * 3600), "0 where there is no list of zones"


@pytest.mark.parametrize(
    ("overrides", "message", "hint"),
    [
        ({"scaling": {"schedule": "weekdays at eight"}}, "no entry of a schedule", "weekdays 08:00 min 4"),
        ({"scaling": {"schedule": "holidays 08:00 min 4"}}, "known are daily, weekdays", "weekdays 08:00"),
        ({"scaling": {"schedule": "daily 24:00 min 4"}}, "24:00", "weekdays 08:00"),
        ({"scaling": {"schedule": "daily 08:00 min 0"}}, "a server is needed", "min 1"),
        ({"scaling": {"schedule": "daily 08:00 min 40"}}, "scaling.max_servers = 10", "smaller number"),
        ({"scaling": {"schedule": "daily 08:00 min 2; mon 8:00 min 3"}}, "mon 08:00", "one of them"),
        ({"scaling": {"time_zone": "8 o'clock"}}, "no time zone", "Asia/Seoul"),
        ({"scaling": {"busy_cpu_percent": 29}}, "less than twice", "underused_s to 0"),
        ({"scaling": {"profile": "slow"}}, "paper, fast", "choose one"),
        ({"scaling": {"profile": "fast", "idle_s": 305}}, "the 10 s of the fast profile", "multiple"),
        ({"cloud": {"warm_servers": 1, "spot": True}}, "cloud.spot exclude each other", "choose one"),
        (
            {"cloud": {"warm_servers": 1, "other_instance_types": "c6i.large"}},
            "cloud.other_instance_types exclude each other",
            "choose one",
        ),
        ({"cloud": {"other_instance_types": "large"}}, "no EC2 type", "c7i.large"),
        ({"cloud": {"other_instance_types": "c7g.large"}}, "ARM", "c7i"),
        ({"cloud": {"instance_type": "t4g.small"}}, "ARM", "c7i"),
    ],
)
def test_what_cannot_be_is_refused_with_a_hint(overrides: dict[str, Any], message: str, hint: str) -> None:
    with pytest.raises(SettingsError) as caught:
        PlatformSettings.from_dict(overrides)

    assert message in caught.value.message
    assert hint in caught.value.hint


@pytest.mark.parametrize("name", ["g5.xlarge", "m7i-flex.large", "u-3tb1.56xlarge", "c6gd", "c5n.18xlarge"])
def test_the_letter_g_alone_makes_no_arm_processor(name: str) -> None:
    if "." in name:
        PlatformSettings.from_dict({"cloud": {"instance_type": name}})
    else:
        with pytest.raises(SettingsError):
            PlatformSettings.from_dict({"cloud": {"instance_type": name}})


@pytest.mark.parametrize(
    ("text", "days"),
    [
        ("", []),
        ("mon 08:00 min 8", [(1,)]),
        ("weekdays 08:00 min 4; weekdays 18:00 min 1", [(1, 2, 3, 4, 5)]),
        ("weekdays 08:00 min 4; fri 18:00 min 1; sat,sun 10:00 min 2", [(1, 2, 3, 4, 5), (0, 6)]),
        ("mon 00:00 min 2; sat 00:00 min 1; sun 00:00 min 1", [(1,), (0,)]),
    ],
)
def test_an_entry_resumes_a_parked_platform_unless_it_lowers_the_minimum(
    text: str, days: list[tuple[int, ...]]
) -> None:
    assert [each.days for each in resuming(parse_schedule(text))] == days
