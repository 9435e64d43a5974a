"""Decide when a new instance may join its group: it must answer its readiness checks within its budget.

The hook's default result is ABANDON, so a machine that says nothing is replaced and never gets a robot.
"""

from __future__ import annotations

from enum import Enum
from typing import Any

from rse_pf.aws.clients import error_code, with_retries
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError

__all__ = ["LaunchAction", "complete_hook", "launch_action", "ready_within_s", "retry_within_s"]

_NOT_ACTIVE = "ValidationError"
"""What Auto Scaling answers where no lifecycle action waits for this instance."""


_RETRY_SHARE, _READY_SHARE = 0.4, 0.3
# The rest is for the machine's own start and for unpacking the environment.


def retry_within_s(settings: PlatformSettings) -> float:
    """Return how long a new machine tries to get its role and its package, of ``cloud.boot_s``."""
    return settings.cloud.boot_s * _RETRY_SHARE


def ready_within_s(settings: PlatformSettings) -> float:
    """Return how long the agent of a new machine waits for its server, of ``cloud.boot_s``."""
    return settings.cloud.boot_s * _READY_SHARE


class LaunchAction(Enum):
    """What an agent does about the launch hook."""

    WAIT = "WAIT"
    CONTINUE = "CONTINUE"
    ABANDON = "ABANDON"


def launch_action(*, is_ready: bool, age_s: float, budget_s: float) -> LaunchAction:
    """Return what to do *age_s* after the agent's start, of which *budget_s* are allowed."""
    if is_ready:
        return LaunchAction.CONTINUE
    return LaunchAction.WAIT if age_s < budget_s else LaunchAction.ABANDON


def complete_hook(autoscaling: Any, *, group: str, hook: str, instance: str, result: str) -> bool:
    """Complete *hook* with *result*; return False where it does not wait, or not yet.

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
