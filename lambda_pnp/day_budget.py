"""Bound what a day of the burst function may cost: commands of one robot, and commands of all.

Any number of executions run at the same time and share nothing but the artifact bucket.  Each takes a lease
of a part of the day's commands there, by compare-and-swap, before it answers them.  What is lost with an
execution that ends is not given again, so the commands of all robots never exceed the budget; the first lease
is small and each further one twice as large, so that executions which end early lose little.  The count of
one robot is kept by each execution alone.
"""

from __future__ import annotations

import json
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Callable, Mapping
from datetime import datetime, timezone
from random import Random
from typing import NamedTuple

from lambda_pnp.keys import signed_request
from rse_pf.config import BurstSettings
from rse_pf.config.resource_names import BUDGET_NAME
from rse_pf.errors import Busy, QuotaExceeded, RsePfError
from rse_pf.identity import RobotId

__all__ = ["BucketAccess", "Claim", "DayBudget", "claim_in_bucket"]

Claim = Callable[[str, int, int], int]
"""Given a day, a number and the most of that day, takes up to that number and returns what was left of it."""

_DAY_S = 86400.0
_LEASES = 200
"""A lease is at most this part of the day's commands."""
_FIRST_LEASE = 50
"""Commands; each further lease of an execution is twice as large as the one before."""
_PAUSE_S = 5.0
_TIMEOUT_S = 3.0
_TRIES, _WAIT_S = 6, 0.1
"""Simulated, 20 executions that claim at the same moment: 0.2 % give up; without a wait 4 tries left 54 %."""
_MAX_BYTES = 4096
_RANDOM = Random()
_NO_OBJECT, _CHANGED = (403, 404), (404, 409, 412)
"""Without the right to list, S3 answers 403 for an object that does not exist."""


class DayBudget:
    """The budget as one execution keeps it."""

    def __init__(self, settings: BurstSettings, claim: Claim) -> None:
        """Describe the budget; nothing is claimed yet."""
        self._settings = settings
        self._claim = claim
        self._day = ""
        self._lease = 0
        self._wanted = _FIRST_LEASE
        self._is_spent = False
        self._next_claim_s = float("-inf")
        self._robots: Counter[RobotId] = Counter()

    def take(self, robot: RobotId, now_s: float) -> None:
        """Take one command of *robot* at Unix time *now_s*.

        Raises:
            QuotaExceeded: The robot's commands of the day are spent, or those of all robots.
            Busy: The bucket cannot be asked.
        """
        day = datetime.fromtimestamp(now_s, timezone.utc).strftime("%Y-%m-%d")
        if day != self._day:
            self._day, self._lease, self._wanted, self._is_spent = day, 0, _FIRST_LEASE, False
            self._robots.clear()
        rest_ms = (_DAY_S - now_s % _DAY_S) * 1e3
        if self._robots[robot] >= self._settings.robot_commands_per_day:
            raise _quota_error("of this robot", self._settings.robot_commands_per_day, rest_ms)
        if self._lease < 1:
            self._renew(now_s)
        if self._is_spent:
            raise _quota_error("of all robots", self._settings.commands_per_day, rest_ms)
        self._lease -= 1
        self._robots[robot] += 1

    def _renew(self, now_s: float) -> None:
        if self._is_spent:
            return
        if now_s < self._next_claim_s:
            raise _unknown_error(self._next_claim_s - now_s)
        requested = min(self._wanted, max(1, self._settings.commands_per_day // _LEASES))
        try:
            self._lease = self._claim(self._day, requested, self._settings.commands_per_day)
        except (OSError, RsePfError) as error:
            self._next_claim_s = now_s + _PAUSE_S
            raise _unknown_error(_PAUSE_S) from error
        self._wanted = 2 * requested
        self._is_spent = self._lease < 1


def _now() -> datetime:
    return datetime.now(timezone.utc)


def _send(request: urllib.request.Request) -> tuple[int, str, bytes]:
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
            return answer.status, answer.headers.get("ETag", ""), answer.read(_MAX_BYTES)
    except urllib.error.HTTPError as error:
        with error:
            return error.code, "", b""


class BucketAccess(NamedTuple):
    """How the bucket is asked, and by which clock.

    Attributes:
        now: Returns the time, UTC.
        send: Returns status, ETag and body of a request to S3.
        sleep: Waits for so many seconds, before a further try.
        random: Returns a number of 0 to 1, for the length of the waits.
    """

    now: Callable[[], datetime] = _now
    send: Callable[[urllib.request.Request], tuple[int, str, bytes]] = _send
    sleep: Callable[[float], None] = time.sleep
    random: Callable[[], float] = _RANDOM.random


_S3 = BucketAccess()


def claim_in_bucket(
    environment: Mapping[str, str], day: str, wanted: int, most: int, access: BucketAccess = _S3
) -> int:
    """Take up to *wanted* commands of *day* in the artifact bucket; return how many of *most* were left.

    Args:
        environment: Of the function.
        day: ``YYYY-MM-DD``, UTC.
        wanted: Commands.
        most: Commands of the whole day.
        access: To the bucket.

    Raises:
        OSError: The bucket cannot be asked, or others keep changing the object.
    """
    now, send, sleep, random = access
    for number in range(_TRIES):
        if number:
            sleep(_WAIT_S * number * random())
        status, etag, body = send(signed_request(environment, now(), name=BUDGET_NAME))
        if status != 200 and status not in _NO_OBJECT:
            raise OSError(f"S3 answers {status}")
        granted = _read_granted(body, day) if status == 200 else 0
        grant = min(wanted, most - granted)
        if grant < 1:
            return 0
        counted = json.dumps({"day": day, "granted": granted + grant}).encode()
        put = signed_request(environment, now(), name=BUDGET_NAME, body=counted)
        put.add_header(*(("If-Match", etag) if status == 200 else ("If-None-Match", "*")))
        status, _, _ = send(put)
        if status == 200:
            return grant
        if status not in _CHANGED:
            raise OSError(f"S3 answers {status}")
    raise OSError("others keep changing the budget")


def _read_granted(body: bytes, day: str) -> int:
    """Return what was granted of *day*; an object of an earlier day counts as none."""
    try:
        record = json.loads(body)
        recorded_day, granted = str(record["day"]), int(record["granted"])
    except (ValueError, KeyError, TypeError) as error:
        raise OSError("the budget in the bucket is damaged") from error
    if recorded_day > day:
        raise OSError("the budget in the bucket is of a later day")
    return granted if recorded_day == day else 0


def _quota_error(whose: str, commands: int, rest_ms: float) -> QuotaExceeded:
    return QuotaExceeded(
        f"the {commands} burst commands {whose} are spent for today",
        hint="ask a server, or compute on the robot",
        retry_after_ms=rest_ms,
    )


def _unknown_error(after_s: float) -> Busy:
    return Busy(
        "the budget of the burst function cannot be read", hint="try later", retry_after_ms=after_s * 1e3
    )
