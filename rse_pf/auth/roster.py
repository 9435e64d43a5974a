"""The roster, which lists the enrolled robots, and the deny list, which lists refused tokens and robots.

An operator writes both, every server reads both; `rse_pf.auth.trust_store` stores and loads them.  They hold
public keys, names and times, no secrets.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import json
import math
import re
import unicodedata
from typing import Annotated, TypeVar

import msgspec

from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.identity import RobotId

__all__ = [
    "MAX_ROBOTS_OF_TENANT",
    "MAX_ROSTER_BYTES",
    "QUOTAS",
    "ROBOT_KEY",
    "DenyList",
    "EnrolledRobot",
    "Roster",
    "check_quotas",
    "check_robot",
    "check_scopes",
    "check_tenant",
    "from_json",
    "key_id_of",
    "public_key_of",
    "scopes_allow",
    "to_json",
]

ROBOT_KEY = "robot:"
"""Prefix of the key ids of robots' own keys; no platform key may have it."""
QUOTAS = ("data_bytes",)
"""What an operator may limit for one robot; without a quota the settings apply."""

SYNTHETIC = "synthetic"
"""The scope that marks a robot of the platform itself, such as the canary.

It allows nothing.  What a synthetic robot sends is answered, and is not counted as load.
"""
_SCOPE = re.compile(
    r"services:(?:\*|[A-Za-z0-9][A-Za-z0-9._-]{0,63})"
    r"|data:(?:\*|read|write)"
    r"|maps:(?:\*|read|write|live|watch|localise)(?:/[a-z0-9][a-z0-9-]{0,63})?"
    r"|topics:(?:\*|read|write)"
    rf"|{SYNTHETIC}"
)
_X = re.compile(r"[A-Za-z0-9_-]{43}")
_MAX_CHARACTERS = 64  # of a name: it is shown in one line, and part of object names
_MAX_SCOPES = 64  # of one robot, which its token carries in each handshake
MAX_ROBOTS_OF_TENANT = 10_000
MAX_ROSTER_BYTES = 16 << 20
"""Every worker of every server reads the whole roster when it changes."""

_T = TypeVar("_T", bound=msgspec.Struct)
Word = Annotated[str, msgspec.Meta(min_length=1, max_length=_MAX_CHARACTERS)]


class _Value(msgspec.Struct, frozen=True, kw_only=True):
    """Unknown fields are ignored, for compatibility with newer versions of the operator's commands."""


class EnrolledRobot(_Value, frozen=True, kw_only=True):
    """A robot with a key of its own.  ``x`` is its public Ed25519 key in base64url, as a JWK has it."""

    robot: Word
    tenant: Word = "default"
    x: Annotated[str, msgspec.Meta(pattern="^[A-Za-z0-9_-]{43}$")]
    scopes: tuple[str, ...] = ()
    quotas: dict[str, float] = {}
    enrolled_s: float = 0.0

    @property
    def key_id(self) -> str:
        """The ``kid`` of the tokens that it signs."""
        return key_id_of(self.x)

    @property
    def id(self) -> RobotId:
        """Its identity; another key under the same name is another robot."""
        return RobotId(self.tenant, self.robot, self.key_id.removeprefix(ROBOT_KEY))


class Roster(_Value, frozen=True, kw_only=True):
    """All enrolled robots."""

    robots: tuple[EnrolledRobot, ...] = ()

    def enrolled(self, robot: EnrolledRobot) -> Roster:
        """Return the roster with *robot*, which replaces an entry of the same tenant and name.

        Raises:
            UsageError: Another robot has this key, or a name that looks the same; or the tenant has as many
                robots as it may have.
        """
        others = tuple(r for r in self.robots if (r.tenant, r.robot) != (robot.tenant, robot.robot))
        shared_form = _shared_form(robot.robot)
        count = sum(other.tenant == robot.tenant for other in others)
        if count >= MAX_ROBOTS_OF_TENANT:
            raise UsageError(
                f"tenant {robot.tenant!r} has {count} robots already, which is the limit",
                hint="remove unused robots: rse-pf robot remove",
            )
        for other in others:
            if other.tenant == robot.tenant and _shared_form(other.robot) == shared_form:
                raise UsageError(
                    f"robot {robot.robot!r} looks like {other.robot!r}, which is enrolled",
                    hint="choose a name that differs in more than case, spaces or a form of its letters",
                )
            if other.x == robot.x:
                raise UsageError(
                    f"robot {other.robot!r} of tenant {other.tenant!r} has this key already",
                    hint="make one key for each robot: rse-pf robot keygen",
                )
        return Roster(robots=(*others, robot))

    def find(self, tenant: str, robot: str) -> EnrolledRobot | None:
        """Return the entry of this tenant and name, None if there is none."""
        return next((r for r in self.robots if (r.tenant, r.robot) == (tenant, robot)), None)


class RevokedToken(_Value, frozen=True, kw_only=True):
    """One token that is refused until it expires."""

    tenant: str
    robot: str
    id: str
    expires_s: float


class DisabledRobot(_Value, frozen=True, kw_only=True):
    """A robot that is refused with any token."""

    tenant: str
    robot: str
    since_s: float


class NotBefore(_Value, frozen=True, kw_only=True):
    """Tokens of this robot that were issued earlier are refused."""

    tenant: str
    robot: str
    at_s: float


class DenyList(_Value, frozen=True, kw_only=True):
    """Tokens and robots that are refused although the signature is valid."""

    tokens: tuple[RevokedToken, ...] = ()
    disabled: tuple[DisabledRobot, ...] = ()
    not_before: tuple[NotBefore, ...] = ()

    def pruned(self, *, now: float, max_token_s: float) -> DenyList:
        """Return the list without the entries that only concern expired tokens.

        Args:
            now: Unix seconds.
            max_token_s: The longest time for which a token is valid, leeway included.
        """
        return DenyList(
            tokens=tuple(token for token in self.tokens if token.expires_s + max_token_s >= now),
            disabled=self.disabled,
            not_before=tuple(limit for limit in self.not_before if limit.at_s + max_token_s >= now),
        )

    def with_token(self, tenant: str, robot: str, token_id: str, expires_s: float) -> DenyList:
        """Return the list with one more token."""
        fresh = RevokedToken(tenant=tenant, robot=robot, id=token_id, expires_s=expires_s)
        return msgspec.structs.replace(self, tokens=(*(t for t in self.tokens if t != fresh), fresh))

    def with_tokens_before(self, tenant: str, robot: str, at_s: float) -> DenyList:
        """Return the list that refuses tokens of *robot* issued before *at_s*; a later time is kept."""
        others = tuple(n for n in self.not_before if (n.tenant, n.robot) != (tenant, robot))
        earlier = [n.at_s for n in self.not_before if n not in others]
        fresh = NotBefore(tenant=tenant, robot=robot, at_s=max([at_s, *earlier]))
        return msgspec.structs.replace(self, not_before=(*others, fresh))

    def with_robot(self, tenant: str, robot: str, since_s: float) -> DenyList:
        """Return the list with *robot* disabled."""
        if self.is_disabled(tenant, robot):
            return self
        fresh = DisabledRobot(tenant=tenant, robot=robot, since_s=since_s)
        return msgspec.structs.replace(self, disabled=(*self.disabled, fresh))

    def without_robot(self, tenant: str, robot: str) -> DenyList:
        """Return the list with *robot* enabled again."""
        others = tuple(d for d in self.disabled if (d.tenant, d.robot) != (tenant, robot))
        return msgspec.structs.replace(self, disabled=others)

    def is_disabled(self, tenant: str, robot: str) -> bool:
        """Return whether *robot* is disabled."""
        return any((d.tenant, d.robot) == (tenant, robot) for d in self.disabled)


def from_json(data: bytes | str, kind: type[_T]) -> _T:
    """Return the `Roster` or `DenyList` in *data*; raises ConfigurationError."""
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigurationError(
            f"the access control store holds no valid {kind.__name__}: {str(error)[:150]}",
            hint="restore its previous version; rse-pf robot and rse-pf token revoke write it",
        ) from error


def to_json(value: Roster | DenyList) -> bytes:
    """Return *value* as it is stored."""
    return msgspec.json.format(msgspec.json.encode(value), indent=1) + b"\n"


@functools.lru_cache(maxsize=1 << 17)
def key_id_of(x: str) -> str:
    """Return the key id of a robot's public key.

    Source:
        RFC 7638: the sha256 of the required members of the JWK, in lexical order.
    """
    canonical = json.dumps({"crv": "Ed25519", "kty": "OKP", "x": x}, separators=(",", ":"))
    digest = hashlib.sha256(canonical.encode()).digest()
    return ROBOT_KEY + base64.urlsafe_b64encode(digest).rstrip(b"=").decode()


def public_key_of(text: str) -> str:
    """Return ``x`` of a public JWK; raises UsageError, above all for a private key."""
    hint = "give the public key that rse-pf robot keygen printed"
    try:
        jwk = json.loads(text)
        kind, curve, x = jwk["kty"], jwk["crv"], jwk["x"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise UsageError("this is not a public key", hint=hint) from error
    if "d" in jwk:
        raise UsageError("this is a private key; it must never leave its robot", hint=hint)
    if (kind, curve) != ("OKP", "Ed25519") or not isinstance(x, str) or not _X.fullmatch(x):
        raise UsageError("this is not a public Ed25519 key", hint=hint)
    return x


def scopes_allow(scopes: tuple[str, ...], right: str, name: str = "") -> bool:
    """Return whether *scopes* allow *right*, such as ``services:pnp`` or ``maps:write``, on object *name*.

    An empty list allows everything; otherwise only what is listed is allowed.
    """
    if not scopes:
        return True
    area = right.partition(":")[0]
    wide = {right, f"{area}:*"}
    return any(
        scope in wide or (name and scope in {f"{area_or_right}/{name}" for area_or_right in wide})
        for scope in scopes
    )


def check_robot(name: str) -> str:
    """Return *name*; raises UsageError if it cannot be the name of a robot."""
    return _check_name(name, "robot")


def check_tenant(name: str) -> str:
    """Return *name*; raises UsageError if it cannot be the name of a tenant."""
    return _check_name(name, "tenant")


@functools.lru_cache(maxsize=1 << 17)
def _shared_form(name: str) -> str:
    """Return a form of *name* that all names share which an operator can hardly tell apart."""
    return " ".join(unicodedata.normalize("NFKC", name).casefold().split())


def _check_name(name: str, owner: str) -> str:
    if not 0 < len(name) <= _MAX_CHARACTERS or not name.isprintable():
        raise UsageError(
            f"{name[:80]!r} is not a valid name for a {owner}", hint="use 1 to 64 printable characters"
        )
    return name


def check_scopes(scopes: tuple[str, ...]) -> tuple[str, ...]:
    """Return *scopes*; raises UsageError if one of them is invalid, or if there are too many."""
    for scope in scopes:
        if not _SCOPE.fullmatch(scope):
            raise UsageError(
                f"{scope[:80]!r} is not a scope",
                hint="write services:NAME, data:read, data:write, maps:read, maps:write, maps:live, "
                "maps:live/MAP, maps:watch/MAP, maps:localise/MAP, topics:read, topics:write or synthetic; "
                "* stands for all of an area",
            )
    if len(scopes) > _MAX_SCOPES:
        raise UsageError(f"{len(scopes)} scopes are above {_MAX_SCOPES}", hint="use services:* and the like")
    return scopes


def check_quotas(quotas: dict[str, float]) -> dict[str, float]:
    """Return *quotas*; raises UsageError for an unknown name or an invalid number."""
    for name, limit in quotas.items():
        if name not in QUOTAS:
            raise UsageError(f"{name[:80]!r} is not a quota", hint=f"known are {', '.join(QUOTAS)}")
        if not (math.isfinite(limit) and limit > 0):
            raise UsageError(
                f"the quota {name} = {limit:g} is not above 0",
                hint="write a number of bytes, or disable the robot",
            )
    return quotas
