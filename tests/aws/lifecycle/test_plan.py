"""Which steps follow from what stands."""

from __future__ import annotations

import pytest

from rse_pf.aws.lifecycle.deployment import Deployment, GroupSize, ParkNote
from rse_pf.aws.lifecycle.plan import Step, plan_down, plan_park, plan_resume, plan_up
from rse_pf.config.resource_names import STACKS
from rse_pf.errors import ConfigurationError

GROUP = GroupSize(min_servers=2, wanted_servers=3, max_servers=10, instances=3)
EMPTY = GroupSize(min_servers=0, wanted_servers=0, max_servers=0)
UP = Deployment(
    stacks=dict.fromkeys(STACKS, "CREATE_COMPLETE"), groups={"rse-pf": GROUP}, is_bootstrapped=True
)
NOTE = ParkNote(groups={"rse-pf": GROUP}, since="2030-01-01T18:00:00+00:00")
PARKED = Deployment(stacks=UP.stacks, groups={"rse-pf": EMPTY}, note=NOTE, is_bootstrapped=True)


def actions(steps: list[Step]) -> list[str]:
    return [f"{step.action} {step.box}".strip() for step in steps]


def test_an_empty_account_is_bootstrapped_and_gets_every_stack_in_order() -> None:
    steps = actions(plan_up(Deployment(), has_packages=False))

    assert steps[:2] == ["build", "bootstrap"]
    assert steps[2:-1] == [f"deploy {box}" for box in STACKS]
    assert steps[-1] == "await-healthy"


def test_a_stack_that_aws_still_changes_is_waited_for() -> None:
    busy = Deployment(stacks={"Network": "CREATE_IN_PROGRESS"}, is_bootstrapped=True)

    steps = actions(plan_up(busy, has_packages=True))

    assert steps[:2] == ["settle Network", "deploy Network"]
    assert "build" not in steps


def test_what_does_not_stand_cannot_be_parked_and_what_is_not_parked_not_resumed() -> None:
    with pytest.raises(ConfigurationError, match="no platform to park"):
        plan_park(Deployment(stacks={"Data": "CREATE_COMPLETE"}), deep=False)
    with pytest.raises(ConfigurationError, match="not parked"):
        plan_resume(UP, has_packages=True)


def test_the_data_goes_last_and_only_on_demand() -> None:
    assert actions(plan_down(UP, delete_data=True))[-4:] == [
        "unprotect Data", "destroy Data", "erase", "sweep",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("deployment", "stage"),
    [
        (Deployment(), "absent"),
        (Deployment(stacks={"Data": "CREATE_COMPLETE"}), "absent"),
        (Deployment(stacks={**UP.stacks, "Backend": "UPDATE_IN_PROGRESS"}), "incomplete"),
        (Deployment(stacks={"Network": "CREATE_COMPLETE"}), "incomplete"),
        (UP, "up"),
        (PARKED, "parked"),
    ],
)
def test_the_stage_is_one_word(deployment: Deployment, stage: str) -> None:
    assert deployment.stage == stage
