"""Enrol robots that have keys of their own, and disable or enable robots.

enrol --out makes a key and writes one file with address, authority and key of the robot: carry it there, and
connect with client_sdk.connect(enrolment=FILE).  Where a private key must not travel, the robot makes its own
with keygen, and the operator enrols the public half.  An enrolled robot signs its own short-lived tokens.
Every change reaches all servers of the platform within 2 s; --cloud means the deployment on AWS.  remove
deletes the public key, so tokens signed by the robot are refused; disable refuses all tokens of the robot,
also those of rse-pf token issue.  A robot that is enrolled in another tenant than the default one is named
with --tenant; list shows all tenants without it.

A name with another key is another robot, which sees nothing of the one before.  adopt gives the robot that
has the name now what was stored under the name without a key, or, with --from-key, under its earlier key.

examples:
  rse-pf robot enrol robot-2 --out robot-2.enrolment
  rse-pf robot keygen --out robot.key > robot.json
  rse-pf robot enrol robot-1 --public-key robot.json --scope services:pnp
  rse-pf robot list
  rse-pf robot list --tenant acme
  rse-pf robot disable robot-1
  rse-pf robot enable robot-1
  rse-pf robot remove robot-1
  rse-pf robot quota robot-1 --quota data_bytes=5e9
  rse-pf robot adopt robot-1
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from rse_pf.auth.roster import (
    DenyList,
    EnrolledRobot,
    Roster,
    check_robot,
    check_scopes,
    public_key_of,
)
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.cli.access.access_control import (
    NOT_ENROLLED_HINT,
    RobotRequest,
    TenantRequest,
    choose_robot,
    described,
    max_token_s,
    read_quotas,
    tenant_or_default,
)
from rse_pf.cli.access.adopt import AdoptRequest, run_adopt
from rse_pf.cli.access.enrolment import EnrolRequest, enrolment_lines, make_enrolment
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.enrolment import Enrolment
from rse_pf.errors import UsageError
from rse_pf.terminal import format_time, show, show_json

__all__ = ["ACTION"]


@dataclass(frozen=True, kw_only=True)
class _KeygenRequest:
    out: Path = option("--out", required=True, metavar="FILE", help="file for the private key")


@dataclass(frozen=True, kw_only=True)
class _ListRequest(TenantRequest):
    json: bool = option("--json", help="print JSON")


@dataclass(frozen=True, kw_only=True)
class _DisableRequest(RobotRequest):
    not_enrolled: bool = option(
        "--not-enrolled",
        help="the robot has no key of its own, and uses tokens of rse-pf token issue",
    )


@dataclass(frozen=True, kw_only=True)
class _QuotaRequest(RobotRequest):
    quota: tuple[str, ...] = option(
        "--quota",
        action="append",
        required=True,
        default=(),
        metavar="NAME=N",
        help="data_bytes=N, the bytes that the robot may store, or data_bytes=default (data.quota_bytes)",
    )


def keygen(request: _KeygenRequest, settings: PlatformSettings) -> None:
    """Make a private key, and print its public half."""
    from rse_pf.auth.robot_key import make_robot_key

    show(make_robot_key(request.out))


def _enrolled_tenant(request: RobotRequest, access: AccessControlStore) -> str:
    """Return the tenant of the enrolled robot of *request*; raises UsageError if there is no such robot."""
    return choose_robot(
        request.robot,
        request.tenant,
        access.roster().robots,
        state="enrolled",
        hint="rse-pf robot list shows which robots are enrolled",
    )


def _tenant(request: _DisableRequest | AdoptRequest, access: AccessControlStore) -> str:
    """Return the tenant of the robot of *request*.

    With --not-enrolled it is the named or the default tenant, and the robot is not looked up.

    Raises:
        UsageError: Without --not-enrolled, no such robot is enrolled; or a name is not valid.
    """
    if request.not_enrolled:
        check_robot(request.robot)
        return tenant_or_default(request.tenant)
    robots = access.roster().robots
    return choose_robot(request.robot, request.tenant, robots, state="enrolled", hint=NOT_ENROLLED_HINT)


def enrol(request: EnrolRequest, settings: PlatformSettings) -> None:
    """Enrol a robot with --public-key, the key that it made, or --out, a new key in a file for the robot.

    A robot of the same tenant and name is replaced; if it had another key, that key is refused within 2 s.
    """
    if (request.public_key is None) == (request.out is None):
        raise UsageError(
            "enrol needs either --out or --public-key",
            hint="--out FILE makes a key and the file for the robot; --public-key takes what keygen printed",
        )
    if (request.url or request.authority) and request.out is None:
        raise UsageError("--url and --authority are for enrol --out", hint="see rse-pf robot enrol --help")
    access = request.open_access_control(settings)
    tenant = tenant_or_default(request.tenant)
    enrolment: Enrolment | None = None
    if request.public_key is None:
        enrolment = make_enrolment(request, tenant, settings)
        public_key = str(enrolment.key["x"])
    else:
        public_key = _public_key(request.public_key)
    robot = EnrolledRobot(
        robot=request.robot,
        tenant=tenant,
        x=public_key,
        scopes=check_scopes(tuple(request.scope)),
        quotas=read_quotas(request.quota),
        enrolled_s=round(time.time(), 3),
    )
    if enrolment is not None and request.out is not None:
        enrolment.write(request.out)
    before = access.roster().find(tenant, request.robot)
    try:
        access.change_roster(lambda roster: roster.enrolled(robot))
    except BaseException:
        if request.out is not None:  # remove the file: the platform does not know its key
            request.out.unlink(missing_ok=True)
        raise
    allowed = " ".join(robot.scopes) or "everything"
    request.record("robot.enrolled", robot.robot, tenant=robot.tenant, key=robot.key_id, scopes=allowed)
    who = described(robot.robot, robot.tenant)
    show(f"{who} is enrolled with {robot.key_id}; it may use {allowed}")
    if before is not None and before.x != robot.x:
        show(
            "its earlier key is refused within 2 s; to give it what it stored under that key:  "
            f"rse-pf robot adopt {robot.robot} --from-key {before.key_id} --tenant {robot.tenant}"
        )
    if enrolment is not None and request.out is not None:
        show(*enrolment_lines(enrolment, request.out))


def adopt(request: AdoptRequest, settings: PlatformSettings) -> None:
    """Move what is stored under an earlier identity of a robot to its present one."""
    access = request.open_access_control(settings)
    tenant = _tenant(request, access)
    adopted = run_adopt(request, tenant, settings, access.roster())
    request.record(
        "robot.adopted", request.robot, tenant=tenant, source=request.from_key,
        objects=adopted.objects, snapshots=adopted.snapshots,
    )  # fmt: skip


def remove(request: RobotRequest, settings: PlatformSettings) -> None:
    """Remove a robot from the roster, with its public key; raises UsageError if it is not enrolled.

    Within 2 s the robot's own tokens are refused, and connections that they authenticated are closed.  Tokens
    of ``rse-pf token issue`` stay valid: a platform key signed them.
    """
    access = request.open_access_control(settings)
    tenant = _enrolled_tenant(request, access)
    enrolled = access.roster().find(tenant, request.robot)
    if enrolled is None:  # another operator has just removed the robot
        raise UsageError(f"robot {request.robot!r} is not enrolled", hint="rse-pf robot list shows who is")

    def without(roster: Roster) -> Roster:
        return Roster(robots=tuple(robot for robot in roster.robots if robot.x != enrolled.x))

    access.change_roster(without)
    request.record("robot.removed", request.robot, tenant=tenant, key=enrolled.key_id)
    who = described(request.robot, tenant)
    show(f"{who} is removed: tokens signed by {enrolled.key_id} are refused within 2 s")


def disable(request: _DisableRequest, settings: PlatformSettings) -> None:
    """Refuse all tokens of a robot until it is enabled again, and close its connections, within 2 s."""
    access = request.open_access_control(settings)
    robot, tenant, now = request.robot, _tenant(request, access), time.time()
    longest = max_token_s(settings)
    access.change_deny_list(
        lambda denied: denied.pruned(now=now, max_token_s=longest).with_robot(tenant, robot, now)
    )
    request.record("robot.disabled", robot, tenant=tenant)
    who = described(robot, tenant)
    show(
        f"{who} is disabled: its connections end within 2 s, and all its tokens are refused",
        f"to let it in again:  rse-pf robot enable {robot} --tenant {tenant}{request.as_option}",
    )


def enable(request: RobotRequest, settings: PlatformSettings) -> None:
    """Accept tokens of a disabled robot again: those that are issued from now on."""
    access, robot, now = request.open_access_control(settings), request.robot, time.time()
    tenant = choose_robot(
        robot,
        request.tenant,
        access.deny_list().disabled,
        state="disabled",
        hint="rse-pf robot list shows which robots are disabled",
    )
    longest, from_s = max_token_s(settings), float(int(now))

    def enabled(denied: DenyList) -> DenyList:
        remaining = denied.pruned(now=now, max_token_s=longest).without_robot(tenant, robot)
        return remaining.with_tokens_before(tenant, robot, from_s)

    access.change_deny_list(enabled)
    request.record("robot.enabled", robot, tenant=tenant)
    show(f"{described(robot, tenant)} is enabled again, for tokens issued since {format_time(from_s)}")


def _public_key(path: Path) -> str:
    """Return the public key in the file *path*, or on standard input for ``-``; raises UsageError."""
    try:
        text = sys.stdin.read() if str(path) == "-" else path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(
            f"cannot read {path}", hint="name the file with the public key that keygen printed"
        ) from error
    return public_key_of(text)


def set_quota(request: _QuotaRequest, settings: PlatformSettings) -> None:
    """Set the bytes that an enrolled robot may store; all servers apply the limit within 2 s."""
    access = request.open_access_control(settings)
    tenant = _enrolled_tenant(request, access)
    quotas = read_quotas(request.quota)

    def changed(roster: Roster) -> Roster:
        return Roster(
            robots=tuple(
                msgspec.structs.replace(robot, quotas=quotas)
                if (robot.tenant, robot.robot) == (tenant, request.robot)
                else robot
                for robot in roster.robots
            )
        )

    access.change_roster(changed)
    limit = f"{quotas['data_bytes']:.0f} bytes" if quotas else "what data.quota_bytes says"
    request.record("robot.quota", request.robot, tenant=tenant, limit=limit)
    show(f"{described(request.robot, tenant)} may store {limit}; all servers apply it within 2 s")


def list_robots(request: _ListRequest, settings: PlatformSettings) -> None:
    """Show the robots that are enrolled or disabled."""
    access = request.open_access_control(settings)
    roster, denied = access.roster(), access.deny_list()
    rows = [_row(robot, denied) for robot in roster.robots]
    for entry in denied.disabled:
        if roster.find(entry.tenant, entry.robot) is None:
            rows.append(
                {
                    "tenant": entry.tenant,
                    "robot": entry.robot,
                    "state": "disabled",
                    "key": "no key of its own",
                    "scopes": [],
                }
            )
    rows = [row for row in rows if request.tenant in (None, row["tenant"])]
    rows.sort(key=lambda row: row["tenant"])
    if request.json:
        show_json(rows, indent=2)
        return
    for row in rows:
        columns = (row["tenant"], row["robot"], row["state"], row["key"], " ".join(row["scopes"]))
        show("  ".join(columns).rstrip())
    if not rows:
        where = "" if request.tenant is None else f" in tenant {request.tenant!r}"
        show(f"no robot is enrolled or disabled{where}; other robots use tokens of rse-pf token issue")


def _row(robot: EnrolledRobot, denied: DenyList) -> dict[str, Any]:
    """Return the row of an enrolled robot in the list, with its state by the deny list *denied*."""
    state = "disabled" if denied.is_disabled(robot.tenant, robot.robot) else "enrolled"
    return {
        "tenant": robot.tenant,
        "robot": robot.robot,
        "state": state,
        "key": robot.key_id,
        "scopes": list(robot.scopes),
        "quotas": robot.quotas,
        "enrolled_s": robot.enrolled_s,
    }


ACTION = Action(
    actions={
        "keygen": Action(
            help="make a private key on the robot, and print the public half",
            example="rse-pf robot keygen --out robot.key > robot.json",
            request=_KeygenRequest,
            run=keygen,
        ),
        "enrol": Action(
            help="enrol a robot with a key of its own",
            example="rse-pf robot enrol robot-2 --out robot-2.enrolment",
            request=EnrolRequest,
            run=enrol,
        ),
        "list": Action(
            help="show the robots that are enrolled or disabled",
            example="rse-pf robot list",
            request=_ListRequest,
            run=list_robots,
        ),
        "disable": Action(
            help="refuse all tokens of a robot until it is enabled",
            example="rse-pf robot disable robot-1",
            request=_DisableRequest,
            run=disable,
        ),
        "enable": Action(
            help="accept the tokens of a disabled robot again",
            example="rse-pf robot enable robot-1",
            request=RobotRequest,
            run=enable,
        ),
        "remove": Action(
            help="delete the public key of a robot",
            example="rse-pf robot remove robot-1",
            request=RobotRequest,
            run=remove,
        ),
        "quota": Action(
            help="set the bytes that a robot may store",
            example="rse-pf robot quota robot-1 --quota data_bytes=5e9",
            request=_QuotaRequest,
            run=set_quota,
        ),
        "adopt": Action(
            help="give a robot what is stored under its earlier identity",
            example="rse-pf robot adopt robot-1",
            request=AdoptRequest,
            run=adopt,
        ),
    },
)
