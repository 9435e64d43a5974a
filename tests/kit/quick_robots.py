"""Robots with short timeouts, for tests against `fake_platform`."""

from __future__ import annotations

import asyncio
import random

import client_sdk
from client_sdk.network.connect_timings import ConnectTimings
from rse_pf.config import SessionSettings
from rse_pf.errors import Conflict, Unauthorized

QUICK = SessionSettings(
    stall_timeout_s=0.3,
    ping_interval_s=0.1,
    ping_timeout_s=0.5,
    hello_timeout_s=1.0,
)
TIMINGS = ConnectTimings(connect_timeout_s=0.5, reconnect_max_s=0.05, reconnect_long_max_s=0.4)


def robot(url, **options):
    return client_sdk.connect(
        url, random=random.Random(1), **{"settings": QUICK, "timings": TIMINGS, **options}
    )


def ask(a_robot, value, **options):
    return asyncio.create_task(a_robot.call("echo", {"value": value}, **options))


async def answered(a_robot):
    """Ask until the servers no longer refuse the robot, and return the answer."""
    while True:
        try:
            return await ask(a_robot, 3, deadline_s=10)
        except (Unauthorized, Conflict):
            await asyncio.sleep(0.01)  # polls, with the deadline of the test
