"""Ten thousand robots of one tenant in the roster, and names that look alike: bounded and typed."""

from __future__ import annotations

import base64
import statistics
import time

import pytest

from rse_pf.auth import roster as roster_file
from rse_pf.auth.roster import MAX_ROBOTS_OF_TENANT, MAX_ROSTER_BYTES, EnrolledRobot, Roster
from rse_pf.auth.tokens import KeySet, SigningKey, verify_token
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.config import AuthSettings
from rse_pf.errors import UsageError
from rse_pf.storage.object_store import MemoryStore

HONEST = SigningKey.of_robot(b"h" * 32)
NOW_S = 1_000_000.0
SETTINGS = AuthSettings()
MAX_RATIO = 1.2


def x_of(number: int) -> str:
    return base64.urlsafe_b64encode(number.to_bytes(32, "big")).rstrip(b"=").decode()


def robots(count: int, tenant: str = "crowd", **more: object) -> tuple[EnrolledRobot, ...]:
    return tuple(
        EnrolledRobot(robot=f"robot-{number}", tenant=tenant, x=x_of(number), **more)  # type: ignore[arg-type]
        for number in range(count)
    )


def test_a_tenant_has_ten_thousand_robots_and_others_are_enrolled_all_the_same() -> None:
    full = Roster(robots=robots(MAX_ROBOTS_OF_TENANT))
    again = EnrolledRobot(robot="robot-7", tenant="crowd", x=x_of(10**6))

    with pytest.raises(UsageError, match=r"tenant 'crowd' has 10000 robots already") as raised:
        full.enrolled(EnrolledRobot(robot="one-more", tenant="crowd", x=x_of(10**6)))

    assert "robot remove" in raised.value.hint
    assert full.enrolled(EnrolledRobot(robot="one-more", tenant="other", x=x_of(10**6))).find(
        "other", "one-more"
    )
    assert full.enrolled(again).find("crowd", "robot-7") == again


def test_a_roster_that_servers_would_not_read_is_not_written() -> None:
    scopes = tuple(f"services:{'s' * 60}{number:03d}" for number in range(64))
    large = Roster(robots=robots(4000, scopes=scopes))
    store = AccessControlStore(MemoryStore())
    store.change_roster(lambda _: Roster(robots=large.robots[:10]))

    with pytest.raises(UsageError, match=f"is above {MAX_ROSTER_BYTES}"):
        store.change_roster(lambda _: large)

    assert len(store.roster().robots) == 10


@pytest.mark.parametrize(
    "name", ["ROBOT-1", "Robot-1", "\uff52obot-1", "robot-\u00b9", "\U0001d42bobot-1", "robot-1"]
)
def test_a_name_that_looks_like_another_of_the_tenant_is_not_enrolled(name: str) -> None:
    known = Roster(robots=(EnrolledRobot(robot="robot-1", tenant="lab", x=x_of(1)),))
    other = EnrolledRobot(robot=name, tenant="lab", x=x_of(2))

    if name == "robot-1":
        assert known.enrolled(other).robots == (other,)
        return
    with pytest.raises(UsageError, match="looks like 'robot-1'"):
        known.enrolled(other)
    assert len(known.enrolled(EnrolledRobot(robot=name, tenant="elsewhere", x=x_of(2))).robots) == 2


def test_a_handshake_costs_the_same_beside_ten_thousand_robots_of_another_tenant() -> None:
    own = EnrolledRobot(robot="honest", tenant="lab", x=str(HONEST.public_json().split('"x": "')[1][:43]))
    few, many = (
        KeySet({}).with_access_control(Roster(robots=(own, *robots(count))), roster_file.DenyList())
        for count in (0, MAX_ROBOTS_OF_TENANT)
    )

    def took_s(keys: KeySet, number: int) -> float:
        token = HONEST.issue("honest", now=NOW_S, token_id=f"t-{number}", settings=SETTINGS)
        begin = time.thread_time()
        verify_token(token, keys=keys, now=NOW_S, settings=SETTINGS)
        return time.thread_time() - begin

    def cost_s(keys: KeySet) -> float:
        return statistics.median(took_s(keys, number) for number in range(200))

    ratios = [cost_s(many) / cost_s(few) for _ in range(10)]

    assert statistics.median(ratios) <= MAX_RATIO
