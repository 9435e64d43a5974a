"""Issue and verify robot tokens: JWTs with an Ed25519 signature, by the best practices of RFC 8725.

PyJWT verifies the signature, the issuer and the audience; the algorithm is fixed, never read from a token.
This module looks up the key by ``kid``, applies the roster and the deny list, and checks the times of a token
against the time that the caller passes.  An enrolled robot signs its own tokens; its tenant, scopes and
quotas come from the roster.  A refusal is always `Unauthorized` with the same message; `token_problem`
returns the cause for the log.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from rse_pf.auth.roster import (
    ROBOT_KEY,
    DenyList,
    EnrolledRobot,
    Roster,
    check_robot,
    check_scopes,
    check_tenant,
    key_id_of,
)
from rse_pf.config import AuthSettings
from rse_pf.errors import MissingExtra, Unauthorized, UsageError
from rse_pf.identity import DEFAULT_TENANT, RobotId

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

__all__ = [
    "ISSUER",
    "Claims",
    "KeySet",
    "ProvenRefusal",
    "SigningKey",
    "claims_problem",
    "proven_refusal",
    "renewed_claims",
    "token_problem",
    "unverified_parts",
    "verify_token",
]

ISSUER = "rse-pf"
"""Issuer (``iss``) of every token; ``auth.audience`` distinguishes platforms."""
_ALGORITHM = "EdDSA"  # the only accepted algorithm of a signature
_TYPE = "robot+jwt"  # type (``typ``) in the header of every token
_CHECKS = {
    "require": ["iss", "aud", "sub", "exp", "iat", "jti"],
    "verify_exp": False, "verify_iat": False, "verify_nbf": False,
}  # fmt: skip
"""Options of PyJWT: it does not check times, because it would compare them with the machine's clock; see
`_check_times`."""
_EXTENSIONS = ("crit", "b64")
"""Members of a header that would change the meaning of a token (RFC 7515, 4.1.11; RFC 7797); a token with one
of them is refused."""
# Longest accepted token in bytes; a longer one is refused before it is decoded.
_MAX_TOKEN_BYTES = 4096
_MAX_REMEMBERED = 8192
"""Verified tokens that a key set remembers, so that it need not verify their signatures again; each takes
about 1 kB."""


class Claims(msgspec.Struct, frozen=True, kw_only=True):
    """The claims of a verified token, the only source of a robot's identity.

    ``quotas`` are pairs of name and limit; times are Unix seconds.
    """

    robot: RobotId
    token_id: str
    issued_s: float
    expires_s: float
    key_id: str
    scopes: tuple[str, ...] = ()
    quotas: tuple[tuple[str, float], ...] = ()

    def quota(self, name: str) -> float | None:
        """Return the robot's limit for *name*, one of `rse_pf.auth.roster.QUOTAS`; None if none is set."""
        return dict(self.quotas).get(name)


class _SignedClaims(NamedTuple):
    """The claims of a token with a valid signature, issuer and audience; its times are not checked yet.

    ``starts_s`` is the Unix time before which the token is not valid (``nbf``), 0 if it states none.
    """

    claims: Claims
    starts_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ProvenRefusal:
    """Why a token was refused that was signed with the key of an enrolled robot, which may learn the reason.

    Attributes:
        cause: The cause, one of the words of `token_problem`.
        off_s: For an expired token the seconds since it expired, otherwise the seconds until it begins to be
            valid; both by the server's clock.
        valid_from_s: The cut-off, in Unix seconds, before which the token was issued; None for other causes.
    """

    cause: str
    off_s: float = 0.0
    valid_from_s: float | None = None


class SigningKey:
    """A private Ed25519 key that signs tokens; it is stored in a file with the mode 0600, or as a secret."""

    def __init__(self, private: Ed25519PrivateKey, key_id: str) -> None:
        self._private = private
        self.key_id = key_id

    @classmethod
    def from_seed(cls, seed: bytes, key_id: str) -> SigningKey:
        """Return the key that is made of *seed*, 32 secret random bytes, under the id *key_id*."""
        return cls(_ed25519().Ed25519PrivateKey.from_private_bytes(seed), key_id)

    @classmethod
    def of_robot(cls, seed: bytes) -> SigningKey:
        """Return a robot's own key, made of *seed*, 32 secret random bytes.

        Its id is `rse_pf.auth.roster.key_id_of` of its public key.
        """
        private = _ed25519().Ed25519PrivateKey.from_private_bytes(seed)
        return cls(private, key_id_of(_b64(private.public_key().public_bytes_raw())))

    @classmethod
    def from_json(cls, text: str | bytes) -> SigningKey:
        """Return the key in *text*, which `to_json` wrote; raises UsageError if it is damaged."""
        try:
            document = json.loads(text)
            return cls.from_seed(_unb64(document["d"]), str(document["kid"]))
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise UsageError("this is not a signing key", hint="make one with rse-pf local") from error

    def to_json(self) -> str:
        """Return the key as a private JWK, which is a secret."""
        return json.dumps({**self._public_jwk(), "d": _b64(self._private.private_bytes_raw())})

    def key_set(self) -> KeySet:
        """Return a key set that holds only the public key of this key."""
        return KeySet({self.key_id: self._private.public_key()})

    def issue(
        self,
        robot: str,
        *,
        now: float,
        token_id: str,
        settings: AuthSettings,
        ttl_s: float | None = None,
        scopes: tuple[str, ...] = (),
        tenant: str = DEFAULT_TENANT,
    ) -> str:
        """Return a new token for *robot*, signed with this key.

        Args:
            robot: Name of the robot.
            now: Unix seconds from which the token is valid.
            token_id: Id of the token (``jti``), 1 to 64 characters; an operator revokes the token by it.
            settings: Audience and longest validity of a token.
            ttl_s: Validity in seconds; None means ``auth.token_ttl_s``, which is also the maximum.
            scopes: What the robot may do; empty allows everything.
            tenant: Tenant of the robot.

        Raises:
            UsageError: An argument is invalid.
        """
        check_robot(robot)
        check_tenant(tenant)
        check_scopes(scopes)
        if not 0 < len(token_id) <= 64:
            raise UsageError("a token id has 1 to 64 characters", hint="let rse-pf token issue choose it")
        ttl_s = settings.token_ttl_s if ttl_s is None else ttl_s
        if not 0 < ttl_s <= settings.token_ttl_s:
            raise UsageError(
                f"a time to live of {ttl_s:g} s is not within {settings.token_ttl_s} s",
                hint=f"give 1 to {settings.token_ttl_s} s, or leave it out; auth.token_ttl_s is the limit",
            )
        claims = {
            "iss": ISSUER,
            "aud": settings.audience,
            "sub": robot,
            "tenant": tenant,
            "iat": int(now),
            "exp": int(now + ttl_s),
            "jti": token_id,
            "scope": " ".join(scopes),
        }
        headers = {"kid": self.key_id, "typ": _TYPE}
        token: str = _jwt().encode(claims, self._private, algorithm=_ALGORITHM, headers=headers)
        return token

    def public_json(self) -> str:
        """Return the public key as a JWK."""
        return json.dumps(self._public_jwk())

    def _public_jwk(self) -> dict[str, str]:
        x = _b64(self._private.public_key().public_bytes_raw())
        return {"kty": "OKP", "crv": "Ed25519", "kid": self.key_id, "x": x}

    def __repr__(self) -> str:
        return f"SigningKey(key_id={self.key_id!r})"


class KeySet:
    """The platform keys and the enrolled robots that a server trusts, and the denied tokens and robots."""

    def __init__(
        self,
        keys: Mapping[str, Ed25519PublicKey],
        *,
        roster: Roster | None = None,
        denied: DenyList | None = None,
    ) -> None:
        self._keys = dict(keys)
        denied = denied or DenyList()
        self._robots = {robot.key_id: robot for robot in (roster or Roster()).robots}
        self._revoked = {(token.tenant, token.robot, token.id) for token in denied.tokens}
        self._disabled = {(robot.tenant, robot.robot) for robot in denied.disabled}
        self._not_before = {(limit.tenant, limit.robot): limit.at_s for limit in denied.not_before}
        self._robot_keys: dict[str, Ed25519PublicKey] = {}
        """Key objects of enrolled robots by key id, each created when the robot's first token is verified."""
        self._enrolled: dict[str, tuple[RobotId, tuple[tuple[str, float], ...]]] = {}
        """Identity and quotas of enrolled robots that had a valid token, by key id."""
        self._signed: dict[bytes, _SignedClaims] = {}
        """The claims of the remembered tokens, by digest of the token."""
        self._digests: dict[RobotId, bytes] = {}
        """The digest of the remembered token of each robot."""

    def with_access_control(self, roster: Roster, denied: DenyList) -> KeySet:
        """Return a new key set with the same platform keys, and with *roster* and *denied*."""
        return KeySet(self._keys, roster=roster, denied=denied)

    @classmethod
    def from_json(cls, text: str) -> KeySet:
        """Return the platform keys in the JWKS *text*; raises UsageError if it is damaged.

        This also imports PyJWT, which takes 0.1 s, so that a server does not import it at its first client: a
        server reads its keys before it forks its workers.
        """
        _jwt()
        public = _ed25519().Ed25519PublicKey
        try:
            return cls(
                {
                    str(jwk["kid"]): public.from_public_bytes(_unb64(jwk["x"]))
                    for jwk in json.loads(text)["keys"]
                }
            )
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise UsageError("this is not a key set", hint="write a JWKS of Ed25519 keys") from error

    def to_json(self) -> str:
        """Return the platform keys as a JWKS, without roster and deny list."""
        keys = [
            {"kty": "OKP", "crv": "Ed25519", "kid": kid, "x": _b64(key.public_bytes_raw())}
            for kid, key in self._keys.items()
        ]
        return json.dumps({"keys": keys})

    def get(self, key_id: Any) -> Ed25519PublicKey | None:
        """Return the public key with the id *key_id*, of the platform or of an enrolled robot.

        None if the set has no such key, or *key_id* is not a text.
        """
        if not isinstance(key_id, str):
            return None
        if not key_id.startswith(ROBOT_KEY):
            return self._keys.get(key_id)
        robot, key = self._robots.get(key_id), self._robot_keys.get(key_id)
        if key is None and robot is not None:
            key = _ed25519().Ed25519PublicKey.from_public_bytes(_unb64(robot.x))
            self._robot_keys[key_id] = key
        return key

    def as_enrolled(self, claims: Claims, enrolled: EnrolledRobot) -> Claims:
        """Return *claims* with the identity, scopes and quotas that the roster has for the robot *enrolled*.

        What the robot's own token states about its tenant and scopes is replaced.
        """
        known = self._enrolled.get(claims.key_id)
        if known is None:
            known = self._enrolled[claims.key_id] = (enrolled.id, tuple(enrolled.quotas.items()))
        robot, quotas = known
        if (claims.robot, claims.scopes, claims.quotas) == (robot, enrolled.scopes, quotas):
            return claims
        return Claims(
            robot=robot, token_id=claims.token_id, issued_s=claims.issued_s, expires_s=claims.expires_s,
            key_id=claims.key_id, scopes=enrolled.scopes, quotas=quotas,
        )  # fmt: skip

    def knows(self, key_id: str) -> bool:
        """Return whether the set has the key *key_id*, without the cost of creating a key object."""
        return key_id in (self._robots if key_id.startswith(ROBOT_KEY) else self._keys)

    def robot_of(self, key_id: str) -> EnrolledRobot | None:
        """Return the enrolled robot with the key *key_id*, None if there is none."""
        return self._robots.get(key_id)

    def find_verified(self, digest: bytes) -> _SignedClaims | None:
        """Return the claims of the remembered token with this *digest*, None if it is not remembered."""
        return self._signed.get(digest)

    def remember(self, digest: bytes, signed: _SignedClaims, robot: RobotId) -> None:
        """Remember the valid token of *robot* with this *digest*, in place of the robot's former one.

        One token of each robot is remembered, so that a robot cannot displace those of others.  Above
        `_MAX_REMEMBERED`, the token that was remembered first is forgotten.  After a change of the roster or
        the deny list a server has a new key set, which remembers no token.
        """
        former = self._digests.pop(robot, None)
        if former is None and len(self._digests) >= _MAX_REMEMBERED:
            former = self._digests.pop(next(iter(self._digests)))
        if former is not None:
            self._signed.pop(former, None)
        self._digests[robot], self._signed[digest] = digest, signed

    def denies(self, claims: Claims) -> str:
        """Return why the deny list refuses *claims*; "" if it does not.

        The causes are ``disabled``, ``revoked`` and ``issued-too-early``.
        """
        robot = (claims.robot.tenant, claims.robot.name)  # an operator denies a name, whatever its key
        if robot in self._disabled:
            return "disabled"
        if (*robot, claims.token_id) in self._revoked:
            return "revoked"
        return "issued-too-early" if claims.issued_s < self.valid_from_s(claims.robot) else ""

    def valid_from_s(self, robot: RobotId) -> float:
        """Return the Unix time of *robot* such that tokens issued earlier are refused; 0 if it has none."""
        return self._not_before.get((robot.tenant, robot.name), 0.0)


def verify_token(token: str, *, keys: KeySet, now: float, settings: AuthSettings) -> Claims:
    """Return the claims of *token*, if it is valid.

    Args:
        token: The token, which is the part of the header Authorization after ``Bearer``.
        keys: The keys that may sign tokens, with the roster and the deny list.
        now: Unix seconds.
        settings: Audience, longest validity, and tolerated difference of clocks.

    Raises:
        Unauthorized: The token is not valid; the message does not say why, see `token_problem`.
    """
    try:
        return _check(token, keys, now, settings)
    except _TokenRefused as refused:
        raise Unauthorized(
            "the token is missing or not valid", hint="issue one with rse-pf token issue ROBOT"
        ) from refused


def claims_problem(claims: Claims, keys: KeySet) -> str:
    """Return why *claims*, which were verified earlier, are no longer valid with *keys*; "" if they are.

    With a cause the caller has to close the connection that they authenticated.  Expiry is not checked.
    """
    if not keys.knows(claims.key_id):
        return "unknown-key"
    enrolled = keys.robot_of(claims.key_id)
    if enrolled is not None and enrolled.id != claims.robot:
        return "wrong-robot"
    return keys.denies(claims)


def renewed_claims(claims: Claims, keys: KeySet) -> Claims:
    """Return *claims* with the scopes and quotas that the roster in *keys* has now.

    `claims_problem` must have found no problem.  The claims of a token that a platform key signed do not
    change.
    """
    enrolled = keys.robot_of(claims.key_id)
    return claims if enrolled is None else keys.as_enrolled(claims, enrolled)


def unverified_parts(token: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the header and the claims of *token* without any verification.

    Raises:
        UsageError: *token* does not have the form of a token.
    """
    try:
        first, second, _ = token.split(".")
        header, claims = json.loads(_unb64(first)), json.loads(_unb64(second))
        if isinstance(header, dict) and isinstance(claims, dict):
            return header, claims
    except (ValueError, RecursionError):
        pass
    raise UsageError("this is not a token", hint="paste what rse-pf token issue printed")


def token_problem(error: Unauthorized) -> str:
    """Return the cause of an error of `verify_token`, such as ``expired``; for the log only.

    Returns ``unknown`` for an error that another function raised.
    """
    return str(error.__cause__) if isinstance(error.__cause__, _TokenRefused) else "unknown"


def proven_refusal(error: Unauthorized) -> ProvenRefusal | None:
    """Return what a robot may learn about *error*, an error of `verify_token`.

    None if the robot's token was not signed with an enrolled key.
    """
    cause = error.__cause__
    return cause.proven if isinstance(cause, _TokenRefused) else None


class _TokenRefused(ValueError):
    """A token is refused; the message is the cause, one of a fixed set of words such as ``expired``."""

    proven: ProvenRefusal | None = None


def _check(token: str, keys: KeySet, now: float, settings: AuthSettings) -> Claims:
    if not token or len(token) > _MAX_TOKEN_BYTES or not token.isascii():
        raise _TokenRefused("missing-or-too-long")
    digest = hashlib.sha256(f"{ISSUER}\n{settings.audience}\n{token}".encode()).digest()
    remembered = keys.find_verified(digest)
    signed = remembered or _signed_claims(token, keys, settings)
    verified = signed.claims
    enrolled = keys.robot_of(verified.key_id)
    is_proven = enrolled is not None and enrolled.robot == verified.robot.name
    try:
        _check_times(signed, now, settings)
        if enrolled is not None:
            if not is_proven:
                raise _TokenRefused("wrong-robot")
            verified = keys.as_enrolled(verified, enrolled)
        denied = keys.denies(verified)
        if denied:
            raise _TokenRefused(denied)
    except _TokenRefused as refused:
        if enrolled is not None and is_proven:
            refused.proven = _proven_refusal(str(refused), signed, enrolled, keys, now)
        raise
    if remembered is None:
        keys.remember(digest, signed, verified.robot)
    return verified


def _proven_refusal(
    cause: str, signed: _SignedClaims, enrolled: EnrolledRobot, keys: KeySet, now: float
) -> ProvenRefusal:
    claims = signed.claims
    off_s = max(claims.issued_s, signed.starts_s) - now
    return ProvenRefusal(
        cause=cause,
        off_s=now - claims.expires_s if cause == "expired" else off_s,
        valid_from_s=keys.valid_from_s(enrolled.id) if cause == "issued-too-early" else None,
    )


def _signed_claims(token: str, keys: KeySet, settings: AuthSettings) -> _SignedClaims:
    """Return the claims of *token* if its form, signature, issuer and audience are valid.

    Raises:
        _TokenRefused: One of these is not.

    Source:
        RFC 7515, 5.2; RFC 7519, 7.2; RFC 8725, 3.
    """
    jwt = _jwt()
    if "=" in token:  # PyJWT accepts padding; without it, a token has one encoding only
        raise _TokenRefused("malformed")
    try:
        header = jwt.get_unverified_header(token)
    except jwt.InvalidTokenError as error:
        raise _TokenRefused("malformed") from error
    if header.get("typ") != _TYPE or not header.keys().isdisjoint(_EXTENSIONS):
        raise _TokenRefused("wrong-algorithm-or-type")
    key_id = header.get("kid")
    key = keys.get(key_id)
    if key is None:
        raise _TokenRefused("unknown-key")
    try:
        claims = jwt.decode(
            token, key, algorithms=[_ALGORITHM], audience=settings.audience, issuer=ISSUER, options=_CHECKS
        )
    except jwt.InvalidAlgorithmError as error:
        raise _TokenRefused("wrong-algorithm-or-type") from error
    except jwt.InvalidTokenError as error:
        raise _TokenRefused("bad-signature-or-claims") from error
    return _claims_in(claims, key_id)


def _claims_in(claims: dict[str, Any], key_id: str) -> _SignedClaims:
    issued, expires, starts = claims["iat"], claims["exp"], claims.get("nbf")
    for stamp in (issued, expires, 0 if starts is None else starts):
        if isinstance(stamp, bool) or not isinstance(stamp, (int, float)) or not 0 <= stamp < 1e11:
            raise _TokenRefused("bad-time")
    robot, token_id = claims["sub"], claims["jti"]
    tenant, scope = claims.get("tenant", DEFAULT_TENANT), claims.get("scope", "")
    if not (isinstance(tenant, str) and tenant and isinstance(scope, str)):
        raise _TokenRefused("bad-subject")
    scopes = scope.split()
    # JSON may hold half a surrogate pair, which neither a log nor the name of an object can.
    is_printable = "".join((robot, token_id, tenant, *scopes)).isprintable()
    if not (0 < len(robot) <= 64 and 0 < len(token_id) <= 64 and is_printable):
        raise _TokenRefused("bad-subject")
    verified = Claims(
        robot=RobotId(tenant, robot), token_id=token_id, issued_s=float(issued), expires_s=float(expires),
        key_id=key_id, scopes=tuple(scopes),
    )  # fmt: skip
    return _SignedClaims(verified, 0.0 if starts is None else float(starts))


def _check_times(signed: _SignedClaims, now: float, settings: AuthSettings) -> None:
    issued, expires = signed.claims.issued_s, signed.claims.expires_s
    if expires - issued > settings.token_ttl_s:
        raise _TokenRefused("ttl-too-long")
    if now > expires + settings.leeway_s:
        raise _TokenRefused("expired")
    if max(issued, signed.starts_s) > now + settings.leeway_s:
        raise _TokenRefused("not-yet-valid")


def _b64(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()


def _unb64(text: str) -> bytes:
    return base64.b64decode(text + "=" * (-len(text) % 4), altchars=b"-_", validate=True)


def _ed25519() -> Any:
    try:
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError as error:
        raise MissingExtra("cryptography", "keys") from error
    return ed25519


def _jwt() -> Any:
    try:
        import jwt
    except ImportError as error:
        raise MissingExtra("pyjwt", "keys") from error
    return jwt
