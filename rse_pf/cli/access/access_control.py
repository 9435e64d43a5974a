"""Options that name a platform, a tenant and a robot, the lookup of that robot, and the record of a change.

A command that changes a robot is refused unless that robot exists: after a wrong name, or without the tenant,
it must not report a success.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from rse_pf.audit.entry import Value
from rse_pf.audit.operator import record
from rse_pf.auth.roster import DisabledRobot, EnrolledRobot, check_quotas, check_robot, check_tenant
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.command_line.options import option
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import UsageError
from rse_pf.identity import DEFAULT_TENANT
from rse_pf.local.state import state_folder

__all__ = [
    "NOT_ENROLLED_HINT", "PlatformRequest", "RobotRequest", "TenantRequest", "choose_robot", "described",
    "max_token_s", "read_quotas", "tenant_or_default",
]  # fmt: skip

NOT_ENROLLED_HINT = (
    "rse-pf robot list shows who is; add --not-enrolled for a robot that uses tokens of rse-pf token issue"
)
# Name of the local platform if --name is not given.
_PLATFORM = "default"


@dataclass(frozen=True, kw_only=True)
class PlatformRequest:
    """The options that name the platform of a command: a local one, or with --cloud the deployment on AWS."""

    cloud: bool = option("--cloud", help="use the deployment on AWS in cloud.region")
    name: str = option("--name", default=_PLATFORM, help=f"name of the local platform (default: {_PLATFORM})")

    @property
    def folder(self) -> Path:
        """State folder of the local platform, which need not exist; raises UsageError for an invalid name."""
        return state_folder(self.name, os.environ)

    @property
    def as_option(self) -> str:
        """The option, after a space, that names this platform in a command; "" for the default platform."""
        if self.cloud:
            return " --cloud"
        return "" if self.name == _PLATFORM else f" --name {self.name}"

    def open_access_control(self, settings: PlatformSettings) -> AccessControlStore:
        """Return the store of roster and deny list of the platform.

        Raises:
            UsageError: There is no such local platform.
        """
        if self.cloud:
            from rse_pf.aws.account import open_account
            from rse_pf.aws.storage.key_store import open_key_store

            account, names = open_account(settings.cloud.region), ResourceNames(settings.cloud.name)
            return open_key_store(account, names).access_control_store()
        from rse_pf.local.disk_watch import access_control_store
        from rse_pf.local.firewall import key_set_file

        if not key_set_file(self.folder).exists():
            started = (each.name for each in self.folder.parent.glob("*/") if key_set_file(each).exists())
            known = ", ".join(sorted(started)) or "none"
            raise UsageError(
                f"there is no platform {self.name!r}", hint=f"start one with rse-pf local; known: {known}"
            )
        return access_control_store(self.folder)

    def record(self, action: str, subject: str, **detail: Value) -> None:
        """Write an entry to the audit log of a local platform; with --cloud, nothing is written.

        On AWS the bucket keeps every version of roster and deny list.

        Args:
            action: What was done, such as ``robot.enrolled``.
            subject: The robot, tenant or key that was changed.
            detail: Further fields of the entry.
        """
        if not self.cloud:
            record(self.folder, action, subject, **detail)


@dataclass(frozen=True, kw_only=True)
class TenantRequest(PlatformRequest):
    """The options that name a platform and a tenant; ``tenant`` is None if it is not named."""

    tenant: str | None = option(
        "--tenant",
        help=f"tenant of the robot (default: {DEFAULT_TENANT}; required if another tenant has such a robot)",
    )


@dataclass(frozen=True, kw_only=True)
class RobotRequest(TenantRequest):
    """The options and the argument that name a robot of a platform."""

    robot: str = option(metavar="ROBOT", help="name of the robot, as in its tokens and logs")


def choose_robot(
    name: str, tenant: str | None, listed: Iterable[EnrolledRobot | DisabledRobot], *, state: str, hint: str
) -> str:
    """Return the tenant of the robot *name*, which the command changes.

    If the command names no tenant, a robot of this name must be listed in the default tenant, and in no
    other.

    Args:
        name: Name of the robot.
        tenant: The tenant that the command names; None if it names none.
        listed: The robots that the command can change.
        state: The state of these robots for messages: ``enrolled`` or ``disabled``.
        hint: Hint of the error if no tenant has such a robot.

    Raises:
        UsageError: No such robot is listed for the tenant; or no tenant is named, and another than the
            default tenant has a robot of this name.
    """
    check_robot(name)
    wanted = tenant_or_default(tenant)
    tenants = sorted({each.tenant for each in listed if each.robot == name})
    if wanted in tenants and (tenant is not None or len(tenants) == 1):
        return wanted
    if not tenants:
        raise UsageError(f"robot {name!r} is not {state} in any tenant", hint=hint)
    where = f"tenant{'s' * (len(tenants) > 1)} {', '.join(map(repr, tenants))}"
    missing = "" if wanted in tenants else f", and not of {wanted!r}"
    raise UsageError(
        f"the {state} robot {name!r} is of {where}{missing}", hint=f"name the tenant: --tenant {tenants[0]}"
    )


def read_quotas(words: Iterable[str]) -> dict[str, float]:
    """Return the quotas by name, from the values ``NAME=N`` of --quota.

    A quota with the value ``default`` is left out, so that the settings apply.

    Raises:
        UsageError: A word is no quota: its name is unknown, or N is no number or out of bounds.
    """
    quotas: dict[str, float] = {}
    for word in words:
        name, _, number = word.partition("=")
        try:
            limit = 1.0 if number == "default" else float(number)
        except ValueError as error:
            raise UsageError(
                f"{word[:80]!r} is not a quota", hint="for example: data_bytes=1e9, or data_bytes=default"
            ) from error
        check_quotas({name: limit})
        if number != "default":
            quotas[name] = limit
    return quotas


def tenant_or_default(tenant: str | None) -> str:
    """Return *tenant*, or the default tenant if it is None; raises UsageError if the name is not valid."""
    return check_tenant(DEFAULT_TENANT if tenant is None else tenant)


def described(robot: str, tenant: str) -> str:
    """Return the words by which messages name a robot: ``robot 'NAME' of tenant 'TENANT'``."""
    return f"robot {robot!r} of tenant {tenant!r}"


def max_token_s(settings: PlatformSettings) -> float:
    """Return the longest time for which servers accept a token after it was issued, in seconds."""
    return float(settings.auth.token_ttl_s + settings.auth.leeway_s)
