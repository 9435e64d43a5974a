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

import secrets
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rse_pf.auth.roster import check_robot
from rse_pf.auth.tokens import KeySet, SigningKey, unverified_parts
from rse_pf.auth.trust_store import AccessControlStore
from rse_pf.cli.access.access_control import (
    NOT_ENROLLED_HINT,
    PlatformRequest,
    RobotRequest,
    choose_robot,
    described,
    max_token_s,
    tenant_or_default,
)
from rse_pf.command_line.options import Action, option
from rse_pf.config import PlatformSettings
from rse_pf.config.resource_names import ResourceNames
from rse_pf.errors import ConfigurationError, Unauthorized, UsageError
from rse_pf.identity import DEFAULT_TENANT
from rse_pf.local.state import platform_settings
from rse_pf.storage.files import OWNER_ONLY, replace_file
from rse_pf.terminal import format_time, show, show_json

if TYPE_CHECKING:
    from rse_pf.aws.storage.key_store import KeyStore

__all__ = ["ACTION"]

# A claim ``exp`` beyond this Unix time, in seconds, is not shown as seconds left: it is no real time.
_LAST_TIME = 1e11
# Random bytes from which a signing key (Ed25519) is made.
_SEED_BYTES = 32
# Default of auth.token_ttl_s, in seconds, for the help page.
_DEFAULT_TTL_S = PlatformSettings().auth.token_ttl_s


@dataclass(frozen=True, kw_only=True)
class _IssueRequest(RobotRequest):
    settings: Path | None = None
    scope: tuple[str, ...] = option(
        "--scope",
        action="append",
        default=(),
        metavar="SCOPE",
        help="allow only this, such as services:pnp or maps:read; repeatable (default: everything)",
    )
    key: Path | None = option("--key", metavar="FILE", help="sign with this key")
    ttl: float | None = option(
        "--ttl",
        metavar="S",
        help=f"time to live in seconds (auth.token_ttl_s, default {_DEFAULT_TTL_S})",
    )


@dataclass(frozen=True, kw_only=True)
class _KeysRequest(PlatformRequest):
    settings: Path | None = None
    keys: Path | None = option(
        "--keys", metavar="FILE", help="verify with this JWKS (default: the keys of the platform)"
    )


@dataclass(frozen=True, kw_only=True)
class _InspectRequest(_KeysRequest):
    token: str = option(metavar="TOKEN", help="the token; - reads standard input")


@dataclass(frozen=True, kw_only=True)
class _RevokeRequest(_KeysRequest):
    token: str | None = option(nargs="?", metavar="TOKEN", help="the token; - reads standard input")
    tenant: str | None = option("--tenant", help="with --all-of: tenant of the robot")
    all_of: str | None = option(
        "--all-of", metavar="ROBOT", help="revoke every token issued to this robot until now"
    )
    not_enrolled: bool = option(
        "--not-enrolled",
        help="with --all-of: the robot has no key of its own, and uses tokens of rse-pf token issue",
    )


@dataclass(frozen=True, kw_only=True)
class _RetireRequest(PlatformRequest):
    force: bool = option("--force", help="also if servers may not know the new key yet")


def issue(request: _IssueRequest, settings: PlatformSettings) -> None:
    """Print a new token for a robot, which need not be enrolled."""
    if request.cloud and request.key is not None:
        raise UsageError("--cloud and --key name two keys", hint="leave one of them out")
    if request.settings is None and request.key is None and not request.cloud:
        settings = platform_settings(request.folder) or settings
    now, token_id, robot = time.time(), secrets.token_hex(8), check_robot(request.robot)
    tenant, key = tenant_or_default(request.tenant), _signing_key(request, settings, now)
    enrolled = () if request.key is not None else request.open_access_control(settings).roster().robots
    if request.tenant is None and any(each.robot == robot for each in enrolled):
        tenant = choose_robot(robot, None, enrolled, state="enrolled", hint="")
    token = key.issue(
        robot,
        now=now,
        token_id=token_id,
        settings=settings.auth,
        ttl_s=request.ttl,
        scopes=request.scope,
        tenant=tenant,
    )
    if request.key is None:
        request.record("token.issued", robot, tenant=tenant, token=token_id)
    show(token)


def revoke(request: _RevokeRequest, settings: PlatformSettings) -> None:
    """Revoke one token, or all tokens of a robot."""
    if request.all_of is not None and request.token is None:
        _revoke_all(request, request.all_of, settings)
        return
    if request.not_enrolled:
        raise UsageError("--not-enrolled is for --all-of", hint="see rse-pf token revoke --help")
    if request.token is None or request.all_of is not None:
        raise UsageError(
            "rse-pf token revoke needs a token, or --all-of ROBOT",
            hint="the token, or - for standard input, comes last",
        )
    _revoke_token(request, request.token, settings)


def _revoke_all(request: _RevokeRequest, name: str, settings: PlatformSettings) -> None:
    """Refuse every token that was issued to robot *name* until now."""
    access, now, longest = request.open_access_control(settings), time.time(), max_token_s(settings)
    robot, from_s = check_robot(name), float(int(now) + 1)  # tokens have whole seconds, rounded down
    tenant = tenant_or_default(request.tenant)
    if not request.not_enrolled:
        tenant = choose_robot(
            robot, request.tenant, access.roster().robots, state="enrolled",
            hint=NOT_ENROLLED_HINT,
        )  # fmt: skip
    access.change_deny_list(
        lambda denied: denied.pruned(now=now, max_token_s=longest).with_tokens_before(tenant, robot, from_s)
    )
    request.record("token.revoked-all", robot, tenant=tenant)
    others = f"{' --not-enrolled' if request.not_enrolled else ''}{request.as_option}"
    show(
        f"tokens of {described(robot, tenant)} from before {format_time(from_s)} are refused, and their "
        "connections end within 2 s",
        "later tokens are valid; to keep the robot out:  "
        f"rse-pf robot disable {robot} --tenant {tenant}{others}",
    )


def _revoke_token(request: _RevokeRequest, token: str, settings: PlatformSettings) -> None:
    """Refuse one token; raises UsageError if no server of the platform accepts it anyway."""
    now, longest = time.time(), max_token_s(settings)
    header, claims = unverified_parts(_token(token))
    name, token_id, over = claims.get("sub"), claims.get("jti"), claims.get("exp")
    if not isinstance(name, str) or not isinstance(token_id, str) or not isinstance(over, (int, float)):
        raise UsageError(
            "this token lacks sub, jti or exp: no server accepts it", hint="there is nothing to do"
        )
    if over + settings.auth.leeway_s < now:
        raise UsageError("this token has expired already", hint="there is nothing to do")
    access = request.open_access_control(settings)
    keys, key_id = _keys(request, settings), str(header.get("kid"))
    if not keys.knows(key_id):
        raise UsageError(
            f"no server of this platform accepts this token: the key {key_id[:80]!r} is not known",
            hint="if another platform issued it, name that one with --name or --cloud",
        )
    enrolled = keys.robot_of(key_id)  # a token that a robot signed is of the tenant that the roster names
    tenant = str(claims.get("tenant", DEFAULT_TENANT)) if enrolled is None else enrolled.tenant
    until_s = min(float(over), now + longest)
    access.change_deny_list(
        lambda denied: denied.pruned(now=now, max_token_s=longest).with_token(tenant, name, token_id, until_s)
    )
    request.record("token.revoked", name, tenant=tenant, token=token_id)
    show(
        f"token {token_id} of {described(name, tenant)} is revoked: it is refused from now on, and its "
        "connections end within 2 s; other tokens of the robot stay valid"
    )


def _signing_key(request: _IssueRequest, settings: PlatformSettings, now: float) -> SigningKey:
    """Return the signing key of the deployment with --cloud, else of --key, else of the local platform."""
    from rse_pf.local.firewall import key_file, read_key

    if request.cloud:
        return _key_store(settings).ring().signer(now)
    return read_key(request.key if request.key is not None else key_file(request.folder))


def _require_cloud(request: PlatformRequest, action: str) -> None:
    if not request.cloud:
        raise UsageError(
            f"rse-pf token {action} is for a cloud",
            hint=f"write rse-pf token {action} --cloud; rse-pf local creates its own key",
        )


def _new_key() -> SigningKey:
    return SigningKey.from_seed(secrets.token_bytes(_SEED_BYTES), secrets.token_hex(8))


def init(request: PlatformRequest, settings: PlatformSettings) -> None:
    """Create the first signing key of a cloud; if there is one, publish its public half again."""
    from rse_pf.aws.storage.key_store import KeyRing, spread_s

    _require_cloud(request, "init")
    store, now = _key_store(settings), time.time()
    existing = store.read()
    if existing is not None:  # an interrupted init may have stored the key without publishing its public half
        store.publish(existing)
        show(f"key {existing.signer(now).key_id} exists already; its public half is published again")
        return
    new = _new_key()
    store.write(KeyRing(keys=((new, now),)))
    show(f"key {new.key_id} is created; servers know it in {spread_s(settings):g} s")


def rotate(request: PlatformRequest, settings: PlatformSettings) -> None:
    """Create a further key of a cloud, which signs tokens as soon as every server has read it."""
    from rse_pf.aws.storage.key_store import spread_s

    _require_cloud(request, "rotate")
    store, new = _key_store(settings), _new_key()
    store.write(store.ring().rotated(new, now=time.time(), settings=settings))
    show(f"key {new.key_id} is published, and signs in {spread_s(settings):g} s")


def retire(request: _RetireRequest, settings: PlatformSettings) -> None:
    """Remove the previous signing key of a cloud, so that servers refuse its tokens."""
    from rse_pf.aws.storage.key_store import spread_s

    _require_cloud(request, "retire")
    store = _key_store(settings)
    ring = store.ring().retired(now=time.time(), force=request.force)
    store.write(ring)
    show(f"only key {ring.keys[0][0].key_id} is trusted; servers know in {spread_s(settings):g} s")


def rotate_keys(request: PlatformRequest, settings: PlatformSettings) -> None:
    """Create a new signing key of a platform; tokens of the previous key stay valid until they expire.

    With --cloud the new key signs only when every server has read it, as with rotate.
    """
    if request.cloud:
        rotate(request, settings)
    else:
        _rotate_local(request)


def _rotate_local(request: PlatformRequest) -> None:
    """Publish the public half of a new key next to that of the present key, then sign with the new key."""
    from rse_pf.local.firewall import key_file, key_set_file, read_key

    folder = request.folder
    old = read_key(key_file(folder))
    new = _new_key()
    halves = {key.key_id: key.key_set().get(key.key_id) for key in (new, old)}
    public = KeySet({name: half for name, half in halves.items() if half is not None})
    replace_file(key_set_file(folder), public.to_json(), mode=0o644)
    replace_file(key_file(folder), new.to_json(), mode=OWNER_ONLY)
    request.record("key.rotated", new.key_id, before=old.key_id)
    show(f"key {new.key_id} signs from now on; tokens of {old.key_id} are valid until they expire")


def _key_store(settings: PlatformSettings) -> KeyStore:
    from rse_pf.aws.account import open_account
    from rse_pf.aws.storage.key_store import open_key_store

    return open_key_store(open_account(settings.cloud.region), ResourceNames(settings.cloud.name))


def inspect(request: _InspectRequest, settings: PlatformSettings) -> int:
    """Print the claims of a token; the exit code is 1 if the token is not valid."""
    if request.settings is None and request.keys is None and not request.cloud:
        settings = platform_settings(request.folder) or settings
    token = _token(request.token)
    header, claims = unverified_parts(token)
    now = time.time()
    verdict, code = _verdict(token, _keys(request, settings), now, settings)
    document = {
        "header": header,
        "claims": claims,
        "seconds_left": _seconds_left(claims, now),
        "verified": verdict,
    }
    show_json(document, indent=2)
    return code


def _token(subject: str) -> str:
    """Return the token *subject*, or for ``-`` the first line of standard input."""
    return sys.stdin.readline().strip() if subject == "-" else str(subject).strip()


def _seconds_left(claims: dict[str, Any], now: float) -> int | None:
    """Return the seconds until the token expires, negative if it has expired.

    None if its claim ``exp`` is no number or no real time.
    """
    over = claims.get("exp")
    is_time = isinstance(over, (int, float)) and not isinstance(over, bool) and abs(over) < _LAST_TIME
    return round(over - now) if is_time and over is not None else None


def _verdict(token: str, keys: Any, now: float, settings: PlatformSettings) -> tuple[str, int]:
    """Return whether *token* is valid, as words, and the exit code: 1 if it is not valid, else 0.

    If *keys* is None, validity is unknown, and the exit code is 0.
    """
    from rse_pf.auth.tokens import token_problem, verify_token

    if keys is None:
        return "unknown: no public keys found; name them with --keys", 0
    try:
        verify_token(token, keys=keys, now=now, settings=settings.auth)
    except Unauthorized as error:
        return f"no: {token_problem(error)}", 1
    return "yes", 0


def _keys(request: _KeysRequest, settings: PlatformSettings) -> Any:
    """Return the public keys of --keys, else of the platform, with its roster and deny list.

    None if --keys is not given and the local platform has no public keys.

    Raises:
        UsageError: The file of --keys does not exist.
        ConfigurationError: The file cannot be read.
    """
    from rse_pf.local.firewall import key_set_file
    from rse_pf.storage.object_store import DirectoryStore

    if request.cloud:
        store = _key_store(settings)
        return _with_access_control(store.published(), store.access_control_store())
    path = request.keys if request.keys is not None else key_set_file(request.folder)
    try:
        keys = KeySet.from_json(path.read_text(encoding="utf-8"))
        return _with_access_control(keys, AccessControlStore(DirectoryStore(path.absolute().parent)))
    except FileNotFoundError as error:
        if request.keys is None:
            return None
        raise UsageError(f"there is no file {path}", hint="name a JWKS with --keys") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"cannot read {path}", hint="name a JWKS with --keys") from error


def _with_access_control(keys: KeySet, access: AccessControlStore) -> KeySet:
    return keys.with_access_control(access.roster(), access.deny_list())


ACTION = Action(
    actions={
        "issue": Action(
            help="print a new token of a robot",
            example="rse-pf token issue robot-1 --scope services:pnp",
            request=_IssueRequest,
            run=issue,
        ),
        "inspect": Action(
            help="show the claims of a token, and whether it is valid",
            example='rse-pf token inspect "$TOKEN"',
            request=_InspectRequest,
            run=inspect,
        ),
        "revoke": Action(
            help="revoke one token, or all tokens of a robot",
            example="rse-pf token revoke --all-of robot-1",
            request=_RevokeRequest,
            run=revoke,
        ),
        "init": Action(
            help="create the first key of a cloud",
            example="rse-pf token init --cloud",
            request=PlatformRequest,
            run=init,
        ),
        "rotate": Action(
            help="create a further key of a cloud, which signs as soon as every server knows it",
            example="rse-pf token rotate --cloud",
            request=PlatformRequest,
            run=rotate,
        ),
        "retire": Action(
            help="remove the previous key of a cloud",
            example="rse-pf token retire --cloud",
            request=_RetireRequest,
            run=retire,
        ),
        "rotate-keys": Action(
            help="create a new key that signs from now on",
            example="rse-pf token rotate-keys",
            request=PlatformRequest,
            run=rotate_keys,
        ),
    },
)
