"""Issue, inspect and revoke robots' tokens; create and rotate the keys that sign them.

A token is signed with the key of a platform that rse-pf local created, with --key FILE, or with --cloud by
the key in the deployment's secret.  inspect needs no secret: it shows the claims of a token, and whether it
is valid under the platform's public keys and deny list.  revoke revokes one token, or with --all-of every
token issued to a robot until now; live connections end within 2 s.  rotate-keys creates a new key; tokens of
the previous one stay valid until they expire.  init, rotate and retire are for --cloud: they create the first
key, create a further one that signs once every server knows it, and remove the previous one.

examples:
  rse-pf token issue robot-1
  rse-pf token issue robot-1 --ttl 60
  rse-pf token issue robot-1 --scope services:pnp --scope maps:read
  rse-pf token inspect "$TOKEN"
  rse-pf token revoke "$TOKEN"
  rse-pf token revoke --all-of robot-1
  rse-pf token rotate-keys
  rse-pf token init --cloud
  rse-pf token issue robot-1 --cloud
"""

from __future__ import annotations

import argparse
import os
import secrets
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rse_pf.auth.roster import check_robot
from rse_pf.auth.tokens import KeySet, SigningKey, unverified_parts
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.cli.access.access_control import (
    NOT_ENROLLED_HINT,
    add_place,
    choose_robot,
    described,
    max_token_s,
    open_access_control,
    record_action,
    tenant_or_default,
    which_platform,
)
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import ConfigurationError, Unauthorized, UsageError
from rse_pf.identity import DEFAULT_TENANT
from rse_pf.storage.files import OWNER_ONLY, replace_file
from rse_pf.terminal import format_time, show, show_json

if TYPE_CHECKING:
    from rse_pf.aws.storage.key_store import KeyStore

__all__ = ["add_arguments", "run"]

_LAST_TIME = 1e11
_CLOUD_ACTIONS = ("init", "rotate", "retire")
_KEY_ACTIONS = (*_CLOUD_ACTIONS, "rotate-keys")
_SEED_BYTES = 32


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    ttl_s = PlatformSettings().auth.token_ttl_s
    parser.add_argument("action", choices=("issue", "inspect", "revoke", *_KEY_ACTIONS), help="what to do")
    parser.add_argument(
        "subject",
        nargs="?",
        metavar="ROBOT|TOKEN",
        help="name of the robot; or the token, - reads standard input",
    )
    add_place(parser)
    parser.add_argument(
        "--scope",
        action="append",
        default=[],
        metavar="SCOPE",
        help="issue: allow only this, such as services:pnp or maps:read; repeatable (default: everything)",
    )
    parser.add_argument(
        "--all-of", metavar="ROBOT", help="revoke: every token issued to this robot until now"
    )
    parser.add_argument(
        "--not-enrolled", action="store_true",
        help="revoke --all-of: a robot without a key of its own, which uses tokens of rse-pf token issue",
    )  # fmt: skip
    parser.add_argument("--key", type=Path, metavar="FILE", help="issue: sign with this key")
    parser.add_argument(
        "--ttl",
        type=float,
        metavar="S",
        help=f"issue: time to live in seconds (auth.token_ttl_s, default {ttl_s})",
    )
    parser.add_argument("--keys", type=Path, metavar="FILE", help="inspect: verify with this JWKS")
    parser.add_argument(
        "--force", action="store_true", help="retire: also if servers may not know the new key yet"
    )


def run(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Do one action, by the settings that the platform was started with unless told otherwise."""
    if args.force and args.action != "retire":
        raise UsageError("--force is for retire", hint="see rse-pf token --help")
    if args.not_enrolled and args.all_of is None:
        raise UsageError("--not-enrolled is for revoke --all-of", hint="see rse-pf token --help")
    if args.action in _KEY_ACTIONS:
        return _change_keys(args, settings)
    if args.action == "revoke":
        return _revoke(args, settings)
    if args.all_of is not None or (args.scope and args.action != "issue"):
        raise UsageError("--all-of is for revoke and --scope for issue", hint="see rse-pf token --help")
    if args.subject is None:
        subject = "the name of a robot" if args.action == "issue" else "a token"
        raise UsageError(f"rse-pf token {args.action} needs {subject}", hint="see rse-pf token --help")
    if args.cloud and args.key is not None:
        raise UsageError("--cloud and --key name two keys", hint="leave one of them out")
    named = args.settings is not None or args.key is not None or args.keys is not None or args.cloud
    chosen = settings if named else _settings_of_platform(args.name) or settings
    if args.action == "issue":
        if args.keys is not None:
            raise UsageError("--keys only checks tokens", hint="name the signing key with --key")
        return _issue(args, chosen)
    if args.key is not None or args.ttl is not None:
        raise UsageError("--key and --ttl are for issue only", hint="check a token with --keys JWKS")
    return _inspect(args, chosen)


def _issue(args: argparse.Namespace, settings: PlatformSettings) -> int:
    now, token_id, robot = time.time(), secrets.token_hex(8), check_robot(args.subject)
    tenant, key = tenant_or_default(args.tenant), _signing_key(args, settings, now)
    enrolled = () if args.key is not None else open_access_control(args, settings).roster().robots
    if args.tenant is None and any(each.robot == robot for each in enrolled):
        tenant = choose_robot(robot, None, enrolled, state="enrolled", hint="")
    token = key.issue(
        robot,
        now=now,
        token_id=token_id,
        settings=settings.auth,
        ttl_s=args.ttl,
        scopes=tuple(args.scope),
        tenant=tenant,
    )
    if args.key is None:
        record_action(args, settings, "token.issued", robot, tenant=tenant, token=token_id)
    show(token)
    return 0


def _revoke(args: argparse.Namespace, settings: PlatformSettings) -> int:
    if (args.subject is None) == (args.all_of is None):
        raise UsageError(
            "rse-pf token revoke needs a token, or --all-of ROBOT", hint="a token or - comes last"
        )
    return _revoke_token(args, settings) if args.all_of is None else _revoke_all(args, settings)


def _revoke_all(args: argparse.Namespace, settings: PlatformSettings) -> int:
    access, now, longest = open_access_control(args, settings), time.time(), max_token_s(settings)
    robot, from_s = check_robot(args.all_of), float(int(now) + 1)  # tokens have whole seconds, rounded down
    tenant = tenant_or_default(args.tenant)
    if not args.not_enrolled:
        tenant = choose_robot(
            robot, args.tenant, access.roster().robots, state="enrolled",
            hint=NOT_ENROLLED_HINT,
        )  # fmt: skip
    access.change_deny_list(
        lambda denied: denied.pruned(now=now, max_token_s=longest).with_tokens_before(tenant, robot, from_s)
    )
    record_action(args, settings, "token.revoked-all", robot, tenant=tenant)
    others = f"{' --not-enrolled' if args.not_enrolled else ''}{which_platform(args)}"
    show(
        f"tokens of {described(robot, tenant)} from before {format_time(from_s)} are refused, and their "
        "connections end within 2 s",
        "later tokens are valid; to keep the robot out:  "
        f"rse-pf robot disable {robot} --tenant {tenant}{others}",
    )
    return 0


def _revoke_token(args: argparse.Namespace, settings: PlatformSettings) -> int:
    now, longest = time.time(), max_token_s(settings)
    header, claims = unverified_parts(_token(args.subject))
    name, token_id, over = claims.get("sub"), claims.get("jti"), claims.get("exp")
    if not isinstance(name, str) or not isinstance(token_id, str) or not isinstance(over, (int, float)):
        raise UsageError(
            "this token lacks sub, jti or exp: no server accepts it", hint="there is nothing to do"
        )
    if over + settings.auth.leeway_s < now:
        raise UsageError("this token has expired already", hint="there is nothing to do")
    access = open_access_control(args, settings)
    keys, key_id = _keys(args, settings), str(header.get("kid"))
    if not keys.knows(key_id):
        raise UsageError(
            f"no server of this platform accepts this token: the key {key_id[:80]!r} is not known",
            hint="if another platform issued it, name that one with --name or --cloud",
        )
    enrolled = keys.robot_of(key_id)  # the roster says whose a token is that a robot signed
    tenant = str(claims.get("tenant", DEFAULT_TENANT)) if enrolled is None else enrolled.tenant
    until_s = min(float(over), now + longest)
    access.change_deny_list(
        lambda denied: denied.pruned(now=now, max_token_s=longest).with_token(tenant, name, token_id, until_s)
    )
    record_action(args, settings, "token.revoked", name, tenant=tenant, token=token_id)
    show(
        f"token {token_id} of {described(name, tenant)} is revoked: it is refused from now on, and its "
        "connections end within 2 s; other tokens of the robot stay valid"
    )
    return 0


def _signing_key(args: argparse.Namespace, settings: PlatformSettings, now: float) -> SigningKey:
    from rse_pf.local.firewall import key_file, read_key

    if args.cloud:
        return _key_store(settings).ring().signer(now)
    return read_key(args.key if args.key is not None else key_file(_folder(args.name)))


def _change_keys(args: argparse.Namespace, settings: PlatformSettings) -> int:
    from rse_pf.aws.storage.key_store import KeyRing, spread_s

    if args.action == "rotate-keys" and args.subject is None and not args.cloud:
        return _rotate_local(args, settings)
    if not args.cloud or args.subject is not None:
        raise UsageError(
            f"rse-pf token {args.action} is for a cloud, and names no robot",
            hint=f"write rse-pf token {args.action} --cloud; rse-pf local creates its own key",
        )
    store, now = _key_store(settings), time.time()
    new = SigningKey.from_seed(secrets.token_bytes(_SEED_BYTES), secrets.token_hex(8))
    if args.action in ("rotate", "rotate-keys"):
        ring = store.ring().rotated(new, now=now, settings=settings)
        store.write(ring)
        show(f"key {new.key_id} is published, and signs in {spread_s(settings):g} s")
        return 0
    if args.action == "retire":
        ring = store.ring().retired(now=now, force=args.force)
        store.write(ring)
        show(f"only key {ring.keys[0][0].key_id} is trusted; servers know in {spread_s(settings):g} s")
        return 0
    there = store.read()
    if there is not None:  # it may never have been published
        store.publish(there)
        show(f"key {there.signer(now).key_id} exists already; its public half is published again")
        return 0
    store.write(KeyRing(keys=((new, now),)))
    show(f"key {new.key_id} is created; servers know it in {spread_s(settings):g} s")
    return 0


def _rotate_local(args: argparse.Namespace, settings: PlatformSettings) -> int:
    """Publish a new key beside the one that signs now, then sign with it."""
    from rse_pf.local.firewall import key_file, key_set_file, read_key

    folder = _folder(args.name)
    old = read_key(key_file(folder))
    new = SigningKey.from_seed(secrets.token_bytes(_SEED_BYTES), secrets.token_hex(8))
    halves = {key.key_id: key.key_set().get(key.key_id) for key in (new, old)}
    public = KeySet({name: half for name, half in halves.items() if half is not None})
    replace_file(key_set_file(folder), public.to_json(), mode=0o644)
    replace_file(key_file(folder), new.to_json(), mode=OWNER_ONLY)
    record_action(args, settings, "key.rotated", new.key_id, before=old.key_id)
    show(f"key {new.key_id} signs from now on; tokens of {old.key_id} are valid until they expire")
    return 0


def _key_store(settings: PlatformSettings) -> KeyStore:
    from rse_pf.aws.account import open_account
    from rse_pf.aws.storage.key_store import open_key_store

    return open_key_store(open_account(settings.cloud.region), ResourceNames(settings.cloud.name))


def _inspect(args: argparse.Namespace, settings: PlatformSettings) -> int:
    token = _token(args.subject)
    header, claims = unverified_parts(token)
    now = time.time()
    verdict, code = _verdict(token, _keys(args, settings), now, settings)
    document = {
        "header": header,
        "claims": claims,
        "seconds_left": _seconds_left(claims, now),
        "verified": verdict,
    }
    show_json(document, indent=2)
    return code


def _token(subject: str) -> str:
    return sys.stdin.readline().strip() if subject == "-" else str(subject).strip()


def _seconds_left(claims: dict[str, Any], now: float) -> int | None:
    over = claims.get("exp")
    is_time = isinstance(over, (int, float)) and not isinstance(over, bool) and abs(over) < _LAST_TIME
    return round(over - now) if is_time and over is not None else None


def _verdict(token: str, keys: Any, now: float, settings: PlatformSettings) -> tuple[str, int]:
    from rse_pf.auth.tokens import token_problem, verify_token

    if keys is None:
        return "unknown: no public keys found; name them with --keys", 0
    try:
        verify_token(token, keys=keys, now=now, settings=settings.auth)
    except Unauthorized as error:
        return f"no: {token_problem(error)}", 1
    return "yes", 0


def _keys(args: argparse.Namespace, settings: PlatformSettings) -> Any:
    """Return the named or the platform's public keys with roster and deny list; None if there are none."""
    from rse_pf.local.firewall import key_set_file
    from rse_pf.storage.object_store import DirectoryStore

    if args.cloud:
        store = _key_store(settings)
        return _with_access_control(store.published(), store.access_control_store())
    path = args.keys if args.keys is not None else key_set_file(_folder(args.name))
    try:
        keys = KeySet.from_json(path.read_text(encoding="utf-8"))
        return _with_access_control(keys, AccessControlStore(DirectoryStore(path.absolute().parent)))
    except FileNotFoundError as error:
        if args.keys is None:
            return None
        raise UsageError(f"there is no file {path}", hint="name a JWKS with --keys") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"cannot read {path}", hint="name a JWKS with --keys") from error


def _with_access_control(keys: KeySet, access: AccessControlStore) -> KeySet:
    return keys.with_access_control(access.roster(), access.deny_list())


def _settings_of_platform(name: str) -> PlatformSettings | None:
    from rse_pf.local.state import platform_settings

    return platform_settings(_folder(name))


def _folder(name: str) -> Path:
    from rse_pf.local.state import state_folder

    return state_folder(name, os.environ)
