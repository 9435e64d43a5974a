"""The roster, which lists the enrolled robots, and the deny list, which lists refused tokens and robots.

An operator changes both lists, and every server reads them; `rse_pf.auth.trust_store` stores and loads them.
They hold public keys, names and times, no secrets.
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
"""Prefix of the id of a key that a robot made itself; the id of no platform key may begin with it."""
QUOTAS = ("data_bytes",)
"""Names of the quotas that an operator may set for one robot; without one the setting applies, for
``data_bytes`` (bytes that the robot may store) ``data.quota_bytes``."""

SYNTHETIC = "synthetic"
"""The scope that marks a robot of the platform itself, such as the canary.

It allows nothing by itself.  The commands of a synthetic robot are answered, but do not count as load.
"""
# The form of each valid scope.
_SCOPE = re.compile(
    r"services:(?:\*|[A-Za-z0-9][A-Za-z0-9._-]{0,63})"
    r"|data:(?:\*|read|write)"
    r"|maps:(?:\*|read|write|live|watch|localise)(?:/[a-z0-9][a-z0-9-]{0,63})?"
    r"|topics:(?:\*|read|write)"
    rf"|{SYNTHETIC}"
)
# The form of the member ``x`` of the JWK of an Ed25519 key: 32 bytes in base64url.
_X = re.compile(r"[A-Za-z0-9_-]{43}")
_MAX_CHARACTERS = 64  # characters of the name of a robot or tenant, which is shown in one line
_MAX_SCOPES = 64  # scopes of one robot, which its token carries in each handshake
MAX_ROBOTS_OF_TENANT = 10_000
"""Robots of one tenant that may be enrolled."""
MAX_ROSTER_BYTES = 16 << 20
"""Largest size of the roster in bytes: each worker of each server reads the whole roster when it changes."""

_T = TypeVar("_T", bound=msgspec.Struct)
# The name of a robot or a tenant.
Word = Annotated[str, msgspec.Meta(min_length=1, max_length=_MAX_CHARACTERS)]


class _Value(msgspec.Struct, frozen=True, kw_only=True):
    """The base of all stored values; unknown fields are ignored, which a newer version may have written."""


class EnrolledRobot(_Value, frozen=True, kw_only=True):
    """A robot whose public key is enrolled.

    ``x`` is the public Ed25519 key in base64url, as in a JWK; ``enrolled_s`` is the Unix time of enrolment.
    Empty ``scopes`` allow everything; without an entry in ``quotas`` the setting applies.
    """

    robot: Word
    tenant: Word = "default"
    x: Annotated[str, msgspec.Meta(pattern="^[A-Za-z0-9_-]{43}$")]
    scopes: tuple[str, ...] = ()
    quotas: dict[str, float] = {}
    enrolled_s: float = 0.0

    @property
    def key_id(self) -> str:
        """The key id (``kid``) in the tokens that this robot signs."""
        return key_id_of(self.x)

    @property
    def id(self) -> RobotId:
        """The identity of this robot; with another key, the same name stands for another robot."""
        return RobotId(self.tenant, self.robot, self.key_id.removeprefix(ROBOT_KEY))


class Roster(_Value, frozen=True, kw_only=True):
    """All enrolled robots."""

    robots: tuple[EnrolledRobot, ...] = ()

    def enrolled(self, robot: EnrolledRobot) -> Roster:
        """Return a roster with *robot* added, which replaces an entry of the same tenant and name.

        Raises:
            UsageError: Another robot has this key, another robot of the tenant has a name that an operator
                could confuse with this one, or the tenant has `MAX_ROBOTS_OF_TENANT` already.
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
        """Return the entry of the robot with this tenant and name, None if it is not enrolled."""
        return next((r for r in self.robots if (r.tenant, r.robot) == (tenant, robot)), None)


class RevokedToken(_Value, frozen=True, kw_only=True):
    """One refused token; after the Unix time ``expires_s`` the token is expired, and the entry not needed."""

    tenant: str
    robot: str
    id: str
    expires_s: float


class DisabledRobot(_Value, frozen=True, kw_only=True):
    """A robot that is refused with every token, since the Unix time ``since_s``."""

    tenant: str
    robot: str
    since_s: float


class NotBefore(_Value, frozen=True, kw_only=True):
    """The cut-off of one robot: tokens that were issued before the Unix time ``at_s`` are refused."""

    tenant: str
    robot: str
    at_s: float


class DenyList(_Value, frozen=True, kw_only=True):
    """The tokens and robots that servers refuse although the signature is valid."""

    tokens: tuple[RevokedToken, ...] = ()
    disabled: tuple[DisabledRobot, ...] = ()
    not_before: tuple[NotBefore, ...] = ()

    def pruned(self, *, now: float, max_token_s: float) -> DenyList:
        """Return the list without the entries that concern expired tokens only; disabled robots are kept.

        Args:
            now: Unix seconds.
            max_token_s: Longest validity of a token in seconds, with the leeway.
        """
        return DenyList(
            tokens=tuple(token for token in self.tokens if token.expires_s + max_token_s >= now),
            disabled=self.disabled,
            not_before=tuple(limit for limit in self.not_before if limit.at_s + max_token_s >= now),
        )

    def with_token(self, tenant: str, robot: str, token_id: str, expires_s: float) -> DenyList:
        """Return the list with one more refused token."""
        fresh = RevokedToken(tenant=tenant, robot=robot, id=token_id, expires_s=expires_s)
        return msgspec.structs.replace(self, tokens=(*(t for t in self.tokens if t != fresh), fresh))

    def with_tokens_before(self, tenant: str, robot: str, at_s: float) -> DenyList:
        """Return the list with the cut-off *at_s* for *robot*; an existing later cut-off is kept."""
        others = tuple(n for n in self.not_before if (n.tenant, n.robot) != (tenant, robot))
        earlier = [n.at_s for n in self.not_before if n not in others]
        fresh = NotBefore(tenant=tenant, robot=robot, at_s=max([at_s, *earlier]))
        return msgspec.structs.replace(self, not_before=(*others, fresh))

    def with_robot(self, tenant: str, robot: str, since_s: float) -> DenyList:
        """Return the list with *robot* disabled since *since_s*; an existing entry is kept."""
        if self.is_disabled(tenant, robot):
            return self
        fresh = DisabledRobot(tenant=tenant, robot=robot, since_s=since_s)
        return msgspec.structs.replace(self, disabled=(*self.disabled, fresh))

    def without_robot(self, tenant: str, robot: str) -> DenyList:
        """Return the list in which *robot* is not disabled any more."""
        others = tuple(d for d in self.disabled if (d.tenant, d.robot) != (tenant, robot))
        return msgspec.structs.replace(self, disabled=others)

    def is_disabled(self, tenant: str, robot: str) -> bool:
        """Return whether *robot* is disabled."""
        return any((d.tenant, d.robot) == (tenant, robot) for d in self.disabled)


def from_json(data: bytes | str, kind: type[_T]) -> _T:
    """Return the `Roster` or `DenyList` in JSON *data*; raises ConfigurationError if it is damaged."""
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigurationError(
            f"the access control store holds no valid {kind.__name__}: {str(error)[:150]}",
            hint="restore its previous version; rse-pf robot and rse-pf token revoke write it",
        ) from error


def to_json(value: Roster | DenyList) -> bytes:
    """Return *value* as the JSON in which it is stored."""
    return msgspec.json.format(msgspec.json.encode(value), indent=1) + b"\n"


@functools.lru_cache(maxsize=1 << 17)
def key_id_of(x: str) -> str:
    """Return the key id of the robot's public key *x* (base64url): `ROBOT_KEY` and the key's thumbprint.

    Source:
        RFC 7638: the sha256 of the required members of the JWK, in lexical order.
    """
    canonical = json.dumps({"crv": "Ed25519", "kty": "OKP", "x": x}, separators=(",", ":"))
    digest = hashlib.sha256(canonical.encode()).digest()
    return ROBOT_KEY + base64.urlsafe_b64encode(digest).rstrip(b"=").decode()


def public_key_of(text: str) -> str:
    """Return the member ``x`` of the public Ed25519 JWK *text*.

    Raises:
        UsageError: *text* is not such a JWK, or holds a private key.
    """
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
    """Return whether *scopes* allow *right*, such as ``services:pnp`` or ``maps:write``.

    Args:
        scopes: The scopes of a robot.  If there are none, everything is allowed.
        right: Area and right.  A scope with ``*`` as its right allows all rights of its area.
        name: Name of a map, for the rights of maps.  A scope such as ``maps:write/NAME`` allows the right on
            this map only; with "" such scopes allow nothing.
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
    """Return *name*; raises UsageError if it is not 1 to 64 printable characters, as for a robot."""
    return _check_name(name, "robot")


def check_tenant(name: str) -> str:
    """Return *name*; raises UsageError if it is not 1 to 64 printable characters, as for a tenant."""
    return _check_name(name, "tenant")


@functools.lru_cache(maxsize=1 << 17)
def _shared_form(name: str) -> str:
    """Return *name* without differences of case, spaces and forms of letters.

    Names with the same result look the same to an operator.
    """
    return " ".join(unicodedata.normalize("NFKC", name).casefold().split())


def _check_name(name: str, kind: str) -> str:
    if not 0 < len(name) <= _MAX_CHARACTERS or not name.isprintable():
        raise UsageError(
            f"{name[:80]!r} is not a valid name for a {kind}", hint="use 1 to 64 printable characters"
        )
    return name


def check_scopes(scopes: tuple[str, ...]) -> tuple[str, ...]:
    """Return *scopes*; raises UsageError if a scope is malformed, or there are more than `_MAX_SCOPES`."""
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
    """Return *quotas*, limits by name; raises UsageError for an unknown name, or a limit not above 0."""
    for name, limit in quotas.items():
        if name not in QUOTAS:
            raise UsageError(f"{name[:80]!r} is not a quota", hint=f"known are {', '.join(QUOTAS)}")
        if not (math.isfinite(limit) and limit > 0):
            raise UsageError(
                f"the quota {name} = {limit:g} is not a finite number above 0",
                hint="write a number of bytes, or disable the robot",
            )
    return quotas
