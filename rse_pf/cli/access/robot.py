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

import argparse
import sys
import time
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
    add_place,
    choose_robot,
    described,
    max_token_s,
    open_access_control,
    read_quotas,
    record_action,
    tenant_or_default,
    which_platform,
)
from rse_pf.cli.access.enrolment import enrolment_lines, make_enrolment
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError
from rse_pf.terminal import format_time, show, show_json

__all__ = ["add_arguments", "run"]

_ACTIONS = ("keygen", "enrol", "list", "disable", "enable", "remove", "quota", "adopt")
_ALSO_NOT_ENROLLED = ("disable", "adopt")
"""Actions that a robot without a key of its own, which uses tokens of the platform, may be named for."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("action", choices=_ACTIONS, help="what to do")
    parser.add_argument(
        "robot", nargs="?", metavar="ROBOT", help="name of the robot, as in its tokens and logs"
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE",
        help="keygen: file for the private key; enrol: file with all that the robot needs to connect",
    )  # fmt: skip
    parser.add_argument(
        "--url", help="enrol --out: where the robot connects (default: the address of the local platform)"
    )
    parser.add_argument(
        "--authority", type=Path, metavar="FILE",
        help="enrol --out: certificate (PEM) of the authority to trust (default: the local platform's)",
    )  # fmt: skip
    parser.add_argument(
        "--public-key",
        type=Path,
        metavar="FILE",
        help="enrol: the public key that keygen printed; - reads standard input",
    )
    parser.add_argument(
        "--scope",
        action="append",
        default=[],
        metavar="SCOPE",
        help="enrol: allow only this, such as services:pnp or maps:read; repeatable (default: everything)",
    )
    parser.add_argument(
        "--quota",
        action="append",
        default=[],
        metavar="NAME=N",
        help="enrol, quota: data_bytes, how much it may store, or default (data.quota_bytes)",
    )
    parser.add_argument(
        "--from-key", default="", metavar="KEY",
        help="adopt: the id of the robot's earlier key (default: what was stored before keys counted)",
    )  # fmt: skip
    parser.add_argument(
        "--store", help="adopt: dir:PATH or s3:BUCKET (default: data.store, or the local platform's)"
    )
    parser.add_argument(
        "--not-enrolled", action="store_true",
        help="disable, adopt: a robot without a key of its own, which uses tokens of rse-pf token issue",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="list: as JSON")
    add_place(parser)


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Do one action."""
    _check(args)
    if args.action == "keygen":
        from rse_pf.auth.robot_key import make_robot_key

        show(make_robot_key(args.out))
        return 0
    access, now = open_access_control(args, settings), time.time()
    if args.action == "list":
        return _list(args, access)
    if args.action == "enrol":
        args.tenant = tenant_or_default(args.tenant)
        return _enrol(args, access, now, settings)
    args.tenant = _tenant(args, access)
    actions = {
        "adopt": _adopt, "remove": _remove, "disable": _disable, "enable": _enable, "quota": _change_quotas,
    }  # fmt: skip
    return actions[args.action](args, access, settings)


def _tenant(args: argparse.Namespace, access: AccessControlStore) -> str:
    """Return the tenant of the robot that *args* mean; raises UsageError if there is no such robot."""
    if args.not_enrolled:
        check_robot(args.robot)
        return tenant_or_default(args.tenant)
    hint = NOT_ENROLLED_HINT if args.action in _ALSO_NOT_ENROLLED else "rse-pf robot list shows who is"
    if args.action == "enable":
        disabled = access.deny_list().disabled
        return choose_robot(args.robot, args.tenant, disabled, state="disabled", hint=hint)
    return choose_robot(args.robot, args.tenant, access.roster().robots, state="enrolled", hint=hint)


def _check(args: argparse.Namespace) -> None:
    """Raise UsageError for arguments that the action does not take."""
    named = args.action not in ("keygen", "list")
    if named != (args.robot is not None):
        problem = "needs the name of a robot" if named else "names no robot"
        raise UsageError(f"rse-pf robot {args.action} {problem}", hint="see rse-pf robot --help")
    if args.action == "keygen" and args.out is None:
        raise UsageError("keygen needs --out", hint="for example: --out robot.key")
    if args.action not in ("keygen", "enrol") and args.out is not None:
        raise UsageError("--out is for keygen and enrol", hint="see rse-pf robot --help")
    if args.action != "enrol" and args.public_key is not None:
        raise UsageError("--public-key is for enrol", hint="see rse-pf robot --help")
    if args.action == "enrol" and (args.public_key is None) == (args.out is None):
        raise UsageError(
            "enrol needs either --out or --public-key",
            hint="--out FILE makes a key and the file for the robot; --public-key takes what keygen printed",
        )
    if (args.url or args.authority) and (args.action != "enrol" or args.out is None):
        raise UsageError("--url and --authority are for enrol --out", hint="see rse-pf robot --help")
    if args.action != "adopt" and (args.from_key or args.store):
        raise UsageError("--from-key and --store are for adopt", hint="see rse-pf robot --help")
    if args.action not in _ALSO_NOT_ENROLLED and args.not_enrolled:
        raise UsageError("--not-enrolled is for disable and adopt", hint="see rse-pf robot --help")
    if args.action != "enrol" and args.scope:
        raise UsageError("--scope is for enrol", hint="enrol the robot again to change its scopes")
    if (args.action == "quota") > bool(args.quota) or (args.quota and args.action not in ("enrol", "quota")):
        raise UsageError("--quota is for enrol and for quota, which needs it", hint="--quota data_bytes=1e9")


def _enrol(
    args: argparse.Namespace, access: AccessControlStore, now: float, settings: PlatformSettings
) -> int:
    enrolment = None if args.out is None else make_enrolment(args, settings)
    robot = EnrolledRobot(
        robot=args.robot,
        tenant=args.tenant,
        x=public_key_of(_text(args.public_key)) if enrolment is None else str(enrolment.key["x"]),
        scopes=check_scopes(tuple(args.scope)),
        quotas=read_quotas(args.quota),
        enrolled_s=round(now, 3),
    )
    if enrolment is not None:
        enrolment.write(args.out)
    before = access.roster().find(args.tenant, args.robot)
    try:
        access.change_roster(lambda roster: roster.enrolled(robot))
    except BaseException:
        if enrolment is not None:  # a file whose key no platform knows
            args.out.unlink(missing_ok=True)
        raise
    allowed = " ".join(robot.scopes) or "everything"
    record_action(
        args, settings, "robot.enrolled", robot.robot, tenant=robot.tenant, key=robot.key_id, scopes=allowed
    )
    who = described(robot.robot, robot.tenant)
    show(f"{who} is enrolled with {robot.key_id}; it may use {allowed}")
    if before is not None and before.x != robot.x:
        show(
            "its earlier key is refused within 2 s; to give it what it stored under that key:  "
            f"rse-pf robot adopt {robot.robot} --from-key {before.key_id} --tenant {robot.tenant}"
        )
    if enrolment is not None:
        show(*enrolment_lines(enrolment, args.out))
    return 0


def _adopt(args: argparse.Namespace, access: AccessControlStore, settings: PlatformSettings) -> int:
    from rse_pf.cli.access.adopt import run_adopt

    adopted = run_adopt(args, settings, access.roster())
    record_action(
        args, settings, "robot.adopted", args.robot, tenant=args.tenant, source=args.from_key,
        objects=adopted.objects, snapshots=adopted.snapshots,
    )  # fmt: skip
    return 0


def _remove(args: argparse.Namespace, access: AccessControlStore, settings: PlatformSettings) -> int:
    enrolled = access.roster().find(args.tenant, args.robot)
    if enrolled is None:  # another operator has just removed it
        raise UsageError(f"robot {args.robot!r} is not enrolled", hint="rse-pf robot list shows who is")

    def without(roster: Roster) -> Roster:
        return Roster(robots=tuple(robot for robot in roster.robots if robot.x != enrolled.x))

    access.change_roster(without)
    record_action(args, settings, "robot.removed", args.robot, tenant=args.tenant, key=enrolled.key_id)
    who = described(args.robot, args.tenant)
    show(f"{who} is removed: tokens signed by {enrolled.key_id} are refused within 2 s")
    return 0


def _disable(args: argparse.Namespace, access: AccessControlStore, settings: PlatformSettings) -> int:
    robot, tenant, now = args.robot, args.tenant, time.time()
    longest = max_token_s(settings)
    access.change_deny_list(
        lambda denied: denied.pruned(now=now, max_token_s=longest).with_robot(tenant, robot, now)
    )
    record_action(args, settings, "robot.disabled", robot, tenant=tenant)
    who = described(robot, tenant)
    show(
        f"{who} is disabled: its connections end within 2 s, and all its tokens are refused",
        f"to let it in again:  rse-pf robot enable {robot} --tenant {tenant}{which_platform(args)}",
    )
    return 0


def _enable(args: argparse.Namespace, access: AccessControlStore, settings: PlatformSettings) -> int:
    robot, tenant, now = args.robot, args.tenant, time.time()
    longest, from_s = max_token_s(settings), float(int(now))

    def enabled(denied: DenyList) -> DenyList:
        remaining = denied.pruned(now=now, max_token_s=longest).without_robot(tenant, robot)
        return remaining.with_tokens_before(tenant, robot, from_s)

    access.change_deny_list(enabled)
    record_action(args, settings, "robot.enabled", robot, tenant=tenant)
    show(f"{described(robot, tenant)} is enabled again, for tokens issued since {format_time(from_s)}")
    return 0


def _text(path: Path) -> str:
    if str(path) == "-":
        return sys.stdin.read()
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(
            f"cannot read {path}", hint="name the file with the public key that keygen printed"
        ) from error


def _change_quotas(args: argparse.Namespace, access: AccessControlStore, settings: PlatformSettings) -> int:
    quotas = read_quotas(args.quota)

    def changed(roster: Roster) -> Roster:
        return Roster(
            robots=tuple(
                msgspec.structs.replace(robot, quotas=quotas)
                if (robot.tenant, robot.robot) == (args.tenant, args.robot)
                else robot
                for robot in roster.robots
            )
        )

    access.change_roster(changed)
    limit = f"{quotas['data_bytes']:.0f} bytes" if quotas else "what data.quota_bytes says"
    record_action(args, settings, "robot.quota", args.robot, tenant=args.tenant, limit=limit)
    show(f"{described(args.robot, args.tenant)} may store {limit}; all servers know it within 2 s")
    return 0


def _list(args: argparse.Namespace, access: AccessControlStore) -> int:
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
    rows = [row for row in rows if args.tenant in (None, row["tenant"])]
    rows.sort(key=lambda row: row["tenant"])
    if args.json:
        show_json(rows, indent=2)
        return 0
    for row in rows:
        columns = (row["tenant"], row["robot"], row["state"], row["key"], " ".join(row["scopes"]))
        show("  ".join(columns).rstrip())
    if not rows:
        where = "" if args.tenant is None else f" in tenant {args.tenant!r}"
        show(f"no robot is enrolled or disabled{where}; other robots use tokens of rse-pf token issue")
    return 0


def _row(robot: EnrolledRobot, denied: DenyList) -> dict[str, Any]:
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
