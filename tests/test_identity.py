"""The identity of a robot, and the names of what belongs to it."""

from __future__ import annotations

import itertools

from hypothesis import strategies as st

from rse_pf.auth.roster import EnrolledRobot
from rse_pf.identity import RobotId, folders_of, shown_name

THUMBPRINT = "kPrK_qmxVWaYVA9wwBF6Iuo3vVzz7TxHCTwXBygrS4k"
words = st.text(min_size=1, max_size=64)
robots = st.builds(RobotId, words, words, st.sampled_from(["", THUMBPRINT]))


def test_robots_that_differ_in_tenant_name_or_enrolment_share_no_folder():
    robots = [
        RobotId(tenant, name, enrolment)
        for tenant, name, enrolment in itertools.product(
            ("a", "b", "a/b", "x=1"), ("r", "b", "r=" + THUMBPRINT, "../r", "R"), ("", THUMBPRINT)
        )
    ]

    assert len({robot.folder for robot in robots}) == len(set(robots)) == len(robots)


def test_a_robot_is_written_without_the_default_tenant_unless_that_is_ambiguous():
    assert str(RobotId("default", "robot-1")) == "robot-1"
    assert str(RobotId("acme", "robot-1")) == "acme/robot-1"
    assert str(RobotId("default", "acme/robot-1")) == "default/acme/robot-1"


def test_a_name_with_another_key_is_another_robot():
    first = EnrolledRobot(robot="r", tenant="acme", x="A" * 43)
    second = EnrolledRobot(robot="r", tenant="acme", x="B" * 43)

    assert first.id != second.id
    assert first.id.folder.startswith("acme/r=")
    assert first.id == EnrolledRobot(robot="r", tenant="acme", x="A" * 43).id


def test_robots_are_shown_by_name_and_found_whatever_their_enrolment():
    folders = [
        RobotId("t", "r1").folder, RobotId("t", "r1", "thumb").folder, RobotId("t", "R 2").folder,
    ]  # fmt: skip

    assert shown_name(folders[0]) == shown_name(folders[1]) == "r1"
    assert folders_of("r1", folders) == folders[:2]
    assert folders_of("R 2", folders) == folders[2:]
    assert folders_of("r", folders) == []
