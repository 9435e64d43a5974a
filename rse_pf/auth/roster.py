"""Which robots hold keys of their own, and which tokens and robots are refused: the control room's values.

An operator writes them, every server reads them; `rse_pf.auth.trust_store` moves them.  Promises no clock,
no store and no secret: public keys, names and times alone.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
from typing import Annotated, TypeVar

import msgspec

from rse_pf.errors import ConfigurationError, UsageError

__all__ = [
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
    "holds",
    "key_id_of",
    "public_key_of",
    "to_json",
]

ROBOT_KEY = "robot:"
"""Key ids of robots' own keys begin so; no platform key may."""
QUOTAS = ("data_bytes",)
"""What an operator may limit for one robot; the settings hold for whoever has no quota."""

_SCOPE = re.compile(
    r"services:(?:\*|[A-Za-z0-9][A-Za-z0-9._-]{0,63})"
    r"|data:(?:\*|read|write)"
    r"|maps:(?:\*|read|write)(?:/[a-z0-9][a-z0-9-]{0,63})?"
)
_X = re.compile(r"[A-Za-z0-9_-]{43}")
_MAX_LETTERS, _MAX_SCOPES = 64, 64

_T = TypeVar("_T", bound=msgspec.Struct)
Word = Annotated[str, msgspec.Meta(min_length=1, max_length=_MAX_LETTERS)]


class _Value(msgspec.Struct, frozen=True, kw_only=True):
    """Unknown fields are ignored, so that a newer operator may say more."""


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


class Roster(_Value, frozen=True, kw_only=True):
    """All enrolled robots."""

    robots: tuple[EnrolledRobot, ...] = ()

    def enrolled(self, robot: EnrolledRobot) -> Roster:
        """Return the roster with *robot*, instead of what that name of that tenant had before.

        Raises:
            UsageError: Another robot holds this key.
        """
        others = tuple(r for r in self.robots if (r.tenant, r.robot) != (robot.tenant, robot.robot))
        for other in others:
            if other.x == robot.x:
                raise UsageError(
                    f"robot {other.robot!r} of tenant {other.tenant!r} holds this key already",
                    hint="make one key for each robot: rse-pf robot keygen",
                )
        return Roster(robots=(*others, robot))

    def find(self, tenant: str, robot: str) -> EnrolledRobot | None:
        """Return the robot called so."""
        return next((r for r in self.robots if (r.tenant, r.robot) == (tenant, robot)), None)


class RevokedToken(_Value, frozen=True, kw_only=True):
    """One token that is refused until its own end."""

    tenant: str
    robot: str
    id: str
    expires_s: float


class DisabledRobot(_Value, frozen=True, kw_only=True):
    """A robot that is refused whatever it shows."""

    tenant: str
    robot: str
    since_s: float


class NotBefore(_Value, frozen=True, kw_only=True):
    """Tokens of this robot that were issued earlier are refused."""

    tenant: str
    robot: str
    at_s: float


class DenyList(_Value, frozen=True, kw_only=True):
    """Who is refused, although the signature is good."""

    tokens: tuple[RevokedToken, ...] = ()
    disabled: tuple[DisabledRobot, ...] = ()
    not_before: tuple[NotBefore, ...] = ()

    def pruned(self, *, now: float, longest_s: float) -> DenyList:
        """Return the list without what time has done: tokens that are over anyway.

        Args:
            now: Unix seconds.
            longest_s: No token is good for longer than that after it was issued, leeway included.
        """
        return DenyList(
            tokens=tuple(each for each in self.tokens if each.expires_s + longest_s >= now),
            disabled=self.disabled,
            not_before=tuple(each for each in self.not_before if each.at_s + longest_s >= now),
        )

    def with_token(self, tenant: str, robot: str, token_id: str, expires_s: float) -> DenyList:
        """Return the list with one more token."""
        fresh = RevokedToken(tenant=tenant, robot=robot, id=token_id, expires_s=expires_s)
        return msgspec.structs.replace(self, tokens=(*(t for t in self.tokens if t != fresh), fresh))

    def with_all_tokens(self, tenant: str, robot: str, at_s: float) -> DenyList:
        """Return the list that refuses every token which *robot* was issued before *at_s*; never an earlier
        time than before.
        """
        others = tuple(n for n in self.not_before if (n.tenant, n.robot) != (tenant, robot))
        earlier = [n.at_s for n in self.not_before if (n.tenant, n.robot) == (tenant, robot)]
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
            f"the control room holds no {kind.__name__}: {str(error)[:150]}",
            hint="restore the version before; rse-pf robot and rse-pf token revoke write it",
        ) from error


def to_json(value: Roster | DenyList) -> bytes:
    """Return *value* as it is stored."""
    return msgspec.json.format(msgspec.json.encode(value), indent=1) + b"\n"


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
    hint = "give what rse-pf robot keygen printed"
    try:
        jwk = json.loads(text)
        kind, curve, x = jwk["kty"], jwk["crv"], jwk["x"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise UsageError("this is no public key", hint=hint) from error
    if "d" in jwk:
        raise UsageError("this is a private key; it never leaves its robot", hint=hint)
    if (kind, curve) != ("OKP", "Ed25519") or not isinstance(x, str) or not _X.fullmatch(x):
        raise UsageError("this is no public Ed25519 key", hint=hint)
    return x


def holds(scopes: tuple[str, ...], right: str, name: str = "") -> bool:
    """Return whether *scopes* allow *right*, as ``services:pnp`` or ``maps:write``, on what is called *name*.

    No scope at all allows everything; any scope makes the list complete.
    """
    if not scopes:
        return True
    area = right.partition(":")[0]
    wide = {right, f"{area}:*"}
    return any(scope in wide or (name and scope in {f"{each}/{name}" for each in wide}) for scope in scopes)


def check_robot(name: str) -> str:
    """Return *name*, or raise UsageError: it cannot name a robot."""
    if not 0 < len(name) <= _MAX_LETTERS or not name.isprintable():
        raise UsageError(f"{name[:80]!r} is no name for a robot", hint="use 1 to 64 printable letters")
    return name


def check_tenant(name: str) -> str:
    """Return *name*, or raise UsageError: it cannot name a tenant."""
    if not 0 < len(name) <= _MAX_LETTERS or not name.isprintable():
        raise UsageError(f"{name[:80]!r} is no name for a tenant", hint="use 1 to 64 printable letters")
    return name


def check_scopes(scopes: tuple[str, ...]) -> tuple[str, ...]:
    """Return *scopes*, or raise UsageError: one of them is none."""
    for scope in scopes:
        if not _SCOPE.fullmatch(scope):
            raise UsageError(
                f"{scope[:80]!r} is no scope",
                hint="write services:NAME, data:read, data:write, maps:read, maps:write or maps:write/MAP; "
                "* stands for all of an area",
            )
    if len(scopes) > _MAX_SCOPES:
        raise UsageError(f"{len(scopes)} scopes are above {_MAX_SCOPES}", hint="use services:* and the like")
    return scopes


def check_quotas(quotas: dict[str, float]) -> dict[str, float]:
    """Return *quotas*, or raise UsageError: a name or a number that means nothing."""
    for name, most in quotas.items():
        if name not in QUOTAS:
            raise UsageError(f"{name[:80]!r} is no quota", hint=f"known are {', '.join(QUOTAS)}")
        if not (math.isfinite(most) and most > 0):
            raise UsageError(f"the quota {name} = {most:g} is not above 0", hint="disable the robot instead")
    return quotas
