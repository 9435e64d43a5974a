"""Decide when a new instance may join its group: its server must become ready within a time limit.

The launch hook's default result is ABANDON: a machine that does not complete the hook is replaced and never
gets a robot.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

from rse_pf.aws.clients import error_code, with_retries
from rse_pf.errors import ConfigurationError

__all__ = ["LaunchAction", "complete_hook", "launch_action"]

_NOT_ACTIVE = "ValidationError"
"""Error code of Auto Scaling if no lifecycle action waits for this instance."""


class LaunchAction(Enum):
    """What an agent does with the launch hook: wait, or complete it with CONTINUE or ABANDON."""

    WAIT = "WAIT"
    CONTINUE = "CONTINUE"
    ABANDON = "ABANDON"


def launch_action(*, is_ready: bool, age_s: float, budget_s: float) -> LaunchAction:
    """Return what to do *age_s* seconds after the agent began to wait for the server, at most *budget_s*.

    CONTINUE if the server is ready, ABANDON after *budget_s* seconds, else WAIT.
    """
    if is_ready:
        return LaunchAction.CONTINUE
    return LaunchAction.WAIT if age_s < budget_s else LaunchAction.ABANDON


def complete_hook(autoscaling: Any, *, group: str, hook: str, instance: str, result: str) -> bool:
    """Complete the lifecycle hook *hook* of *instance* with *result* (``CONTINUE`` or ``ABANDON``).

    Return False if the hook does not wait for this instance now, so that nothing was completed.

    Raises:
        ConfigurationError: AWS refused for another reason.
        StoreError: AWS does not answer.
    """
    from botocore.exceptions import ClientError

    try:
        with_retries(
            lambda: autoscaling.complete_lifecycle_action(
                AutoScalingGroupName=group, LifecycleHookName=hook, InstanceId=instance,
                LifecycleActionResult=result,
            )
        )  # fmt: skip
    except ClientError as error:
        if error_code(error) == _NOT_ACTIVE:
            return False
        raise ConfigurationError(
            f"AWS refuses complete_lifecycle_action of {hook}: {error_code(error)}",
            hint="check the role's policy in the template",
        ) from error
    return True
