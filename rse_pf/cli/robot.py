"""Enrol robots that hold keys of their own, and shut robots out or let them in again.

A robot makes its key itself and keeps it; what it gives away is the public half.  Enrolled, it signs its own
short tokens.  Every server of the platform knows within 2 s; --cloud means the deployment on AWS.  remove
forgets its key, so nothing that the robot signs is good; disable also refuses what rse-pf token issue made.

examples:
  rse-pf robot keygen --out robot.key > robot.json
  rse-pf robot enrol robot-1 --public-key robot.json --scope services:pnp
  rse-pf robot list
  rse-pf robot disable robot-1
  rse-pf robot enable robot-1
  rse-pf robot remove robot-1
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from rse_pf.audit.chain import Value
from rse_pf.auth.roster import (
    DenyList,
    EnrolledRobot,
    Roster,
    check_quotas,
    check_robot,
    check_scopes,
    check_tenant,
    public_key_of,
)
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.cli.operator import record
from rse_pf.config import PlatformSettings
from rse_pf.errors import UsageError

__all__ = ["add_arguments", "add_place", "control_room", "longest_s", "note", "run"]

_DEFAULT = "default"
_ACTIONS = ("keygen", "enrol", "list", "disable", "enable", "remove")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("action", choices=_ACTIONS, help="what to do")
    parser.add_argument("robot", nargs="?", metavar="ROBOT", help="its name, as its tokens and logs show it")
    parser.add_argument("--out", type=Path, metavar="FILE", help="keygen: where the private key goes")
    parser.add_argument(
        "--public-key", type=Path, metavar="FILE", help="enrol: what keygen printed; - reads it"
    )
    parser.add_argument(
        "--scope", action="append", default=[], metavar="SCOPE",
        help="enrol: allow this alone, as services:pnp or maps:read; again for more (default: everything)",
    )  # fmt: skip
    parser.add_argument(
        "--quota", action="append", default=[], metavar="NAME=N",
        help="enrol: data_bytes, all that it may store (default: data.quota_bytes)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="list: as JSON")
    add_place(parser)


def add_place(parser: argparse.ArgumentParser) -> None:
    """Declare which platform is meant, and which tenant."""
    parser.add_argument("--tenant", default=_DEFAULT, help=f"whose robot (default: {_DEFAULT})")
    parser.add_argument("--cloud", action="store_true", help="the deployment on AWS in cloud.region")
    parser.add_argument("--name", default=_DEFAULT, help=f"which local platform (default: {_DEFAULT})")


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Do one action."""
    _check(args)
    if args.action == "keygen":
        from rse_pf.auth.robot_key import make_robot_key

        print(make_robot_key(args.out))
        return 0
    room, now = open_access_control(args, settings), time.time()
    if args.action == "list":
        return _list(args, room)
    robot, tenant = check_robot(args.robot), check_tenant(args.tenant)
    longest = longest_s(settings)
    if args.action == "enrol":
        return _enrol(args, room, now, settings)
    if args.action == "remove":
        return _remove(args, room, settings)
    if args.action == "disable":
        room.change_deny_list(
            lambda denied: denied.pruned(now=now, longest_s=longest).with_robot(tenant, robot, now)
        )
        note(args, settings, "robot.disabled", robot, tenant=tenant)
        print(f"robot {robot!r} is disabled: its connections end within 2 s, and no token of it is taken")
        return 0
    if not room.deny_list().is_disabled(tenant, robot):
        raise UsageError(f"robot {robot!r} is not disabled", hint="rse-pf robot list shows who is")

    def enabled(denied: DenyList) -> DenyList:
        kept = denied.pruned(now=now, longest_s=longest).without_robot(tenant, robot)
        return kept.with_all_tokens(tenant, robot, float(int(now)))

    room.change_deny_list(enabled)
    note(args, settings, "robot.enabled", robot, tenant=tenant)
    print(f"robot {robot!r} may come in again, with tokens that are made from now on")
    return 0


def open_access_control(args: argparse.Namespace, settings: PlatformSettings) -> AccessControlStore:
    """Return the control room of the platform that *args* name; raises UsageError if there is none."""
    if args.cloud:
        from rse_pf.aws.account import open_account
        from rse_pf.aws.storage.key_store import open_key_store

        return open_key_store(open_account(settings.cloud.region)).access_control_store()
    from rse_pf.local.firewall import key_set_file
    from rse_pf.local.state import state_folder
    from rse_pf.object_store import DirectoryStore

    folder = state_folder(args.name, os.environ)
    if not key_set_file(folder).exists():
        raise UsageError(f"there is no platform {args.name!r}", hint="start one with rse-pf local")
    return AccessControlStore(DirectoryStore(folder))


def note(
    args: argparse.Namespace, settings: PlatformSettings, action: str, subject: str, **detail: Value
) -> None:
    """Record what was done in the audit log of a local platform; in a cloud the bucket keeps all versions."""
    if not args.cloud:
        from rse_pf.local.state import state_folder

        record(state_folder(args.name, os.environ), action, subject, **detail)


def longest_s(settings: PlatformSettings) -> float:
    """Return how long after it was issued a token may be good at most."""
    return float(settings.auth.token_ttl_s + settings.auth.leeway_s)


def _check(args: argparse.Namespace) -> None:
    """Refuse words that the action does not take."""
    named = args.action in ("enrol", "disable", "enable", "remove")
    if named != (args.robot is not None):
        what = "needs the name of a robot" if named else "names no robot"
        raise UsageError(f"rse-pf robot {args.action} {what}", hint="see rse-pf robot --help")
    if (args.action == "keygen") != (args.out is not None):
        raise UsageError("--out belongs to keygen, which needs it", hint="for example: --out robot.key")
    if (args.action == "enrol") != (args.public_key is not None):
        raise UsageError(
            "--public-key belongs to enrol, which needs it", hint="give the file with what keygen printed"
        )
    if args.action != "enrol" and (args.scope or args.quota):
        raise UsageError("--scope and --quota are for enrol", hint="enrol the robot again to change them")


def _enrol(args: argparse.Namespace, room: AccessControlStore, now: float, settings: PlatformSettings) -> int:
    robot = EnrolledRobot(
        robot=args.robot,
        tenant=args.tenant,
        x=public_key_of(_text(args.public_key)),
        scopes=check_scopes(tuple(args.scope)),
        quotas=check_quotas(dict(_quota(each) for each in args.quota)),
        enrolled_s=round(now, 3),
    )
    room.change_roster(lambda roster: roster.enrolled(robot))
    allowed = " ".join(robot.scopes) or "everything"
    note(args, settings, "robot.enrolled", robot.robot, tenant=robot.tenant, key=robot.key_id, scopes=allowed)
    print(f"robot {robot.robot!r} is enrolled with {robot.key_id}; it may use {allowed}")
    return 0


def _remove(args: argparse.Namespace, room: AccessControlStore, settings: PlatformSettings) -> int:
    found = room.roster().find(args.tenant, args.robot)
    if found is None:
        raise UsageError(f"robot {args.robot!r} is not enrolled", hint="rse-pf robot list shows who is")

    def without(roster: Roster) -> Roster:
        return Roster(robots=tuple(each for each in roster.robots if each.x != found.x))

    room.change_roster(without)
    note(args, settings, "robot.removed", args.robot, tenant=args.tenant, key=found.key_id)
    print(f"robot {args.robot!r} is enrolled no more: what {found.key_id} signed is refused within 2 s")
    return 0


def _text(path: Path) -> str:
    if str(path) == "-":
        return sys.stdin.read()
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read {path}", hint="give the file with what keygen printed") from error


def _quota(text: str) -> tuple[str, float]:
    name, _, number = text.partition("=")
    try:
        return name, float(number)
    except ValueError as error:
        raise UsageError(f"{text[:80]!r} is no quota", hint="for example: data_bytes=1e9") from error


def _list(args: argparse.Namespace, room: AccessControlStore) -> int:
    roster, denied = room.roster(), room.deny_list()
    rows = [_row(robot, denied) for robot in roster.robots if robot.tenant == args.tenant]
    for each in denied.disabled:
        if each.tenant == args.tenant and roster.find(each.tenant, each.robot) is None:
            rows.append({"robot": each.robot, "state": "disabled", "key": "no key of its own", "scopes": []})
    if args.json:
        print(json.dumps(rows, indent=2))
        return 0
    for row in rows:
        print(f"{row['robot']}  {row['state']}  {row['key']}  {' '.join(row['scopes'])}".rstrip())
    if not rows:
        print("no robot is enrolled or disabled; others come in with tokens of rse-pf token issue")
    return 0


def _row(robot: EnrolledRobot, denied: DenyList) -> dict[str, Any]:
    state = "disabled" if denied.is_disabled(robot.tenant, robot.robot) else "enrolled"
    return {
        "robot": robot.robot, "state": state, "key": robot.key_id, "scopes": list(robot.scopes),
        "quotas": robot.quotas, "enrolled_s": robot.enrolled_s,
    }  # fmt: skip
