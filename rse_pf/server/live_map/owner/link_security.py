"""What secures a connection between a worker and the owner of a live map on another server.

The owner makes its certificate when it starts, and its lease, which only servers can write, says the sha256:
the worker pins it.  The worker shows a token: signed with a key that only servers can read, valid for 30 s,
for this map, this owner and this certificate only.  Time is an argument.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import secrets
import ssl
from typing import Any

import msgspec

from rse_pf.auth.certificates import issue_server_certificate, make_authority
from rse_pf.errors import Conflict, NotFound, StoreError, Unauthorized
from rse_pf.object_store import ObjectStore
from rse_pf.server.live_map.owner.lease import INTERNAL_KEY

__all__ = [
    "TOKEN_S",
    "LinkClaims",
    "check_certificate",
    "check_token",
    "client_context",
    "internal_key",
    "make_token",
    "server_context",
]

TOKEN_S = 30.0
"""How long a token is valid."""
_KEY_BYTES = 32
_TLS = ssl.TLSVersion.TLSv1_3


class LinkClaims(msgspec.Struct, frozen=True, kw_only=True):
    """Which map, of which owner, a worker may use; ``expires_s`` is Unix time."""

    tenant: str
    map_name: str
    epoch: int
    certificate: str
    expires_s: float


_encode = msgspec.json.Encoder().encode
_decode = msgspec.json.Decoder(LinkClaims).decode


def internal_key(store: ObjectStore) -> bytes:
    """Return the key of the tokens between servers, and make it if there is none.

    Raises:
        StoreError: The store fails, or the key in it is damaged.
    """
    try:
        key = store.get(INTERNAL_KEY)
    except NotFound:
        key = secrets.token_bytes(_KEY_BYTES)
        try:
            store.compare_and_swap(INTERNAL_KEY, None, key)
        except Conflict:
            key = store.get(INTERNAL_KEY)
    if len(key) != _KEY_BYTES:
        raise StoreError(f"{INTERNAL_KEY!r} is no key", hint="delete it; servers make another")
    return key


def make_token(key: bytes, claims: LinkClaims) -> bytes:
    """Return *claims* with their signature."""
    body = _encode(claims)
    return hmac.digest(key, body, "sha256") + body


def check_token(key: bytes, token: bytes, expected: LinkClaims, *, now_s: float, leeway_s: float) -> None:
    """Raise Unauthorized unless *token* is signed with *key*, is valid now and is for *expected*.

    Args:
        key: Of `internal_key`.
        token: Of `make_token`.
        expected: All but ``expires_s`` must be equal.
        now_s: Unix time.
        leeway_s: Difference between the clocks of two servers that is tolerated.
    """
    size = hashlib.sha256().digest_size
    signature, body = token[:size], token[size:]
    if not hmac.compare_digest(signature, hmac.digest(key, body, "sha256")):
        raise _refused()
    try:
        claims = _decode(body)
    except msgspec.MsgspecError as error:
        raise _refused() from error
    is_for_us = msgspec.structs.replace(claims, expires_s=expected.expires_s) == expected
    if not is_for_us or not now_s - leeway_s < claims.expires_s <= now_s + TOKEN_S + leeway_s:
        raise _refused()


def server_context(address: str, *, now_s: float) -> tuple[ssl.SSLContext, str]:
    """Return the TLS context of an owner with a new certificate for *address*, and its sha256 in hex.

    The private key is never on a disk.

    Raises:
        MissingExtra: ``cryptography`` is not installed.
    """
    made = issue_server_certificate(make_authority("live map", now_s=now_s), [address], now_s=now_s)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = _TLS
    file = os.memfd_create("certificate", os.MFD_CLOEXEC)
    with os.fdopen(file, "wb") as memory:
        memory.write(made.pem.encode("ascii"))
        memory.flush()
        context.load_cert_chain(f"/proc/self/fd/{file}")
    return context, hashlib.sha256(ssl.PEM_cert_to_DER_cert(made.certificate)).hexdigest()


def client_context() -> ssl.SSLContext:
    """Return the TLS context of a worker; the certificate is judged by `check_certificate`."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = _TLS
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE  # pinned instead: nobody but the owner has the key of this one
    return context


def check_certificate(connection: Any, expected: str) -> None:
    """Raise Unauthorized unless the other side of *connection* showed the certificate *expected*.

    Args:
        connection: The ``ssl_object`` of a transport.
        expected: The sha256 in hex, from the lease.
    """
    shown = connection.getpeercert(binary_form=True) or b""
    if not hmac.compare_digest(hashlib.sha256(shown).hexdigest(), expected):
        raise _refused()


def _refused() -> Unauthorized:
    return Unauthorized(
        "the connection between two servers was refused",
        hint="check that their clocks agree, and that they use the same store",
    )
