"""Authenticate the TLS connection between a worker and the map server of a live map on any backend server.

Only servers have access to the leases and the key below ``live/`` in the object store.

1. A map server makes a self-signed certificate when it starts and writes its SHA-256 into the lease.
2. A worker connects with TLS 1.3 and pins that SHA-256.
3. The worker sends a token, signed by HMAC-SHA-256 with the key.  The token is valid for 30 s, and for one
   tenant, map, epoch and certificate, so that it cannot be used at another map server.
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
from rse_pf.storage.object_store import ObjectStore

__all__ = [
    "INTERNAL_KEY",
    "MAX_MESSAGE_BYTES",
    "TOKEN_S",
    "ConnectionClaims",
    "check_certificate",
    "check_token",
    "client_context",
    "internal_key",
    "make_token",
    "server_context",
]

INTERNAL_KEY = "live/key=internal"
"""Object name of the key that signs tokens between servers.  No tenant's folder is named ``key=internal``,
because a folder of a tenant contains an equals sign only as the second character, after an ``x``."""
MAX_MESSAGE_BYTES = 4 << 20
"""Largest message in bytes between a worker and a map server; longer ones are refused before decoding."""
TOKEN_S = 30.0
"""Validity in seconds of the token with which a worker opens a connection to a map server."""
_KEY_BYTES = 32  # length of the key that signs tokens: that of the output of SHA-256
_TLS_VERSION = ssl.TLSVersion.TLSv1_3


class ConnectionClaims(msgspec.Struct, frozen=True, kw_only=True):
    """The content of a token between servers: for which connection, and until when, it is valid.

    Attributes:
        tenant: Tenant of the live map.
        map_name: Name of the live map.
        epoch: Epoch of the map server's lease.
        certificate: SHA-256 in hex of the map server's certificate.
        expires_s: Unix time in seconds at which the token expires.
    """

    tenant: str
    map_name: str
    epoch: int
    certificate: str
    expires_s: float


_encode = msgspec.json.Encoder().encode
_decode = msgspec.json.Decoder(ConnectionClaims).decode


def internal_key(store: ObjectStore) -> bytes:
    """Return the 32-byte key that signs tokens between servers; create and store it if there is none.

    Raises:
        StoreError: The store fails, or the stored key has a wrong length.
    """
    try:
        key = store.get(INTERNAL_KEY)
    except NotFound:
        key = secrets.token_bytes(_KEY_BYTES)
        try:
            store.compare_and_swap(INTERNAL_KEY, None, key)
        except Conflict:  # another server has stored a key meanwhile: use that one
            key = store.get(INTERNAL_KEY)
    if len(key) != _KEY_BYTES:
        raise StoreError(
            f"the key {INTERNAL_KEY!r} has {len(key)} bytes instead of {_KEY_BYTES}",
            hint="delete this object and restart all servers; one of them makes a new key",
        )
    return key


def make_token(key: bytes, claims: ConnectionClaims) -> bytes:
    """Return the token with *claims*: 32 bytes of HMAC-SHA-256 under *key*, then the claims as JSON."""
    body = _encode(claims)
    return hmac.digest(key, body, "sha256") + body


def check_token(
    key: bytes, token: bytes, expected: ConnectionClaims, *, now_s: float, leeway_s: float
) -> None:
    """Raise Unauthorized unless *token* is signed with *key*, valid now, and made for this connection.

    Args:
        key: Key of `internal_key`.
        token: Result of `make_token` on the worker's side.
        expected: Claims that the token must have; ``expires_s`` is ignored.
        now_s: Current Unix time in seconds.
        leeway_s: Tolerated difference between the clocks of two servers, in seconds.  A token that expires
            later than ``TOKEN_S + leeway_s`` from now is refused too, because the clock of its sender is
            wrong.
    """
    signature_bytes = hashlib.sha256().digest_size
    signature, body = token[:signature_bytes], token[signature_bytes:]
    if not hmac.compare_digest(signature, hmac.digest(key, body, "sha256")):
        raise _token_refused()
    try:
        claims = _decode(body)
    except msgspec.MsgspecError as error:
        raise _token_refused() from error
    is_for_this_connection = msgspec.structs.replace(claims, expires_s=expected.expires_s) == expected
    is_valid_now = now_s - leeway_s < claims.expires_s <= now_s + TOKEN_S + leeway_s
    if not is_for_this_connection or not is_valid_now:
        raise _token_refused()


def server_context(address: str, *, now_s: float) -> tuple[ssl.SSLContext, str]:
    """Make a certificate for *address* and a TLS context for a map server that uses it.

    The private key is passed to OpenSSL through a file in memory; it is never written to a disk.

    Args:
        address: Host name or IP address at which workers reach the map server.
        now_s: Current Unix time in seconds, from which the certificate is valid.

    Returns:
        The TLS context, and the SHA-256 in hex of the certificate.

    Raises:
        MissingExtra: The package ``cryptography`` is not installed.
    """
    issued = issue_server_certificate(make_authority("live map", now_s=now_s), [address], now_s=now_s)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = _TLS_VERSION
    descriptor = os.memfd_create("certificate", os.MFD_CLOEXEC)
    with os.fdopen(descriptor, "wb") as memory_file:
        memory_file.write(issued.pem.encode("ascii"))
        memory_file.flush()
        context.load_cert_chain(f"/proc/self/fd/{descriptor}")
    return context, hashlib.sha256(ssl.PEM_cert_to_DER_cert(issued.certificate)).hexdigest()


def client_context() -> ssl.SSLContext:
    """Return the TLS context with which a worker connects to a map server.

    The context accepts every certificate: call `check_certificate` after the handshake.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = _TLS_VERSION
    context.check_hostname = False
    # OpenSSL verifies no certificate: that of a map server is self-signed, and check_certificate compares it
    # with the SHA-256 in the lease.
    context.verify_mode = ssl.CERT_NONE
    return context


def check_certificate(connection: Any, expected: str) -> None:
    """Raise Unauthorized unless the peer of a TLS connection has the pinned certificate.

    Args:
        connection: The ``ssl_object`` of an asyncio transport.
        expected: SHA-256 in hex of the certificate, from the lease of the map.
    """
    certificate = connection.getpeercert(binary_form=True) or b""
    if not hmac.compare_digest(hashlib.sha256(certificate).hexdigest(), expected):
        raise Unauthorized(
            "the map server does not have the certificate that its lease names",
            hint="let servers reach each other directly, without a proxy that terminates TLS",
        )


def _token_refused() -> Unauthorized:
    return Unauthorized(
        "the token of a worker is not valid for this map server",
        hint="set the clocks of both servers, and check that both use the same data.store",
    )
