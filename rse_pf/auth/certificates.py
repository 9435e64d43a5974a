"""A certificate authority of one platform, and the server certificates that it issues (X.509, ECDSA P-256).

The authority may certify IP addresses and names under ``local`` only (name constraints), so that someone who
steals its key cannot impersonate other sites to a browser that trusts the authority.  The caller passes the
time, and reads and writes the files; the random numbers of keys come from the operating system.

Source:
    RFC 5280, chapter "Certificate Extensions": subject alternative name, name constraints.
"""

from __future__ import annotations

import datetime
import hashlib
import ipaddress
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rse_pf.errors import MissingExtra, UsageError

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

__all__ = ["AUTHORITY_S", "SERVER_S", "CertificateWithKey", "issue_server_certificate", "make_authority"]

AUTHORITY_S = 3650 * 86400
"""Validity of an authority's certificate in seconds: ten years, because robots keep this certificate."""
SERVER_S = 90 * 86400
"""Validity of a server certificate in seconds: 90 days; browsers refuse more than 398 days."""
_EARLIER_S = 86400
"""Seconds before its creation from which a certificate is valid, because the clock of a robot may be slow."""
# Hint of the errors about a damaged file of an authority.
_HINT = "remove the file; a new one is made, and robots must be enrolled again"


@dataclass(frozen=True, slots=True, kw_only=True)
class CertificateWithKey:
    """A certificate and its private key, both as PEM texts; ``private_key`` is a secret."""

    certificate: str
    private_key: str

    @property
    def pem(self) -> str:
        """The certificate and the private key in one PEM text, as a file holds them; a secret."""
        return self.certificate + self.private_key

    @classmethod
    def from_pem(cls, text: str) -> CertificateWithKey:
        """Return the certificate and the key in *text*, which `pem` made.

        Raises:
            UsageError: The text is damaged, or the key is not that of the certificate.
            MissingExtra: ``cryptography`` is not installed.
        """
        certificate, marker, key = text.partition("-----BEGIN PRIVATE KEY-----")
        pair = cls(certificate=certificate, private_key=marker + key)
        pair._read()
        return pair

    @property
    def expires_s(self) -> float:
        """The Unix time at which the certificate expires."""
        return self._read()[0].not_valid_after_utc.timestamp()

    @property
    def names(self) -> tuple[str, ...]:
        """The IP addresses and host names for which the certificate is valid; empty for an authority."""
        x509, _, _ = _cryptography()
        try:
            extension = self._read()[0].extensions.get_extension_for_class(x509.SubjectAlternativeName)
        except x509.ExtensionNotFound:
            return ()
        return tuple(str(name.value) for name in extension.value)

    @property
    def fingerprint(self) -> str:
        """The SHA-256 of the certificate as browsers show it: pairs of hex digits, joined by colons."""
        _, _, serialization = _cryptography()
        digest = hashlib.sha256(self._read()[0].public_bytes(serialization.Encoding.DER)).hexdigest().upper()
        return ":".join(digest[at : at + 2] for at in range(0, len(digest), 2))

    def is_issued_by(self, authority: CertificateWithKey) -> bool:
        """Return whether *authority* signed this certificate."""
        try:
            self._read()[0].verify_directly_issued_by(authority._read()[0])
        except Exception:  # noqa: BLE001  the library raises errors of several families for a wrong signature
            return False
        return True

    def _read(self) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
        x509, ec, serialization = _cryptography()
        try:
            certificate = x509.load_pem_x509_certificate(self.certificate.encode())
            key = serialization.load_pem_private_key(self.private_key.encode(), None)
        except (ValueError, TypeError) as error:
            raise UsageError("this is not a certificate with its key", hint=_HINT) from error
        if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
            raise UsageError("certificate and key do not belong together", hint=_HINT)
        return certificate, key


def make_authority(name: str, *, now_s: float) -> CertificateWithKey:
    """Return a new certificate authority for the platform *name*, valid until `AUTHORITY_S` after *now_s*.

    *now_s* is in Unix seconds.

    Raises:
        MissingExtra: ``cryptography`` is not installed.
    """
    x509, ec, _ = _cryptography()
    key = ec.generate_private_key(ec.SECP256R1())
    subject = _subject(f"RSE-PF authority of platform {name}")
    everywhere = [ipaddress.ip_network("0.0.0.0/0"), ipaddress.ip_network("::/0")]
    permitted = [
        *map(x509.IPAddress, everywhere),
        x509.DNSName("local"),
        x509.DNSName("localhost"),
    ]
    builder = (
        _builder(subject, subject, key, now_s, AUTHORITY_S)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(key_cert_sign=True, crl_sign=True), critical=True)
        .add_extension(
            x509.NameConstraints(permitted_subtrees=permitted, excluded_subtrees=None), critical=True
        )
    )
    return _sign(builder, key, key)


def issue_server_certificate(
    authority: CertificateWithKey, names: Sequence[str], *, now_s: float
) -> CertificateWithKey:
    """Return a new server certificate for *names* with its key.

    It is valid until `SERVER_S` after *now_s*, but not longer than *authority*.

    Args:
        authority: The authority that signs the certificate.
        names: At least one IP address or name under ``local``, to which clients connect.
        now_s: Unix seconds.

    Raises:
        MissingExtra: ``cryptography`` is not installed.
        UsageError: The certificate or the key of *authority* is damaged.
    """
    x509, ec, _ = _cryptography()
    signer, signing_key = authority._read()
    key = ec.generate_private_key(ec.SECP256R1())
    until_s = min(now_s + SERVER_S, authority.expires_s)
    builder = (
        _builder(_subject("RSE-PF platform"), signer.subject, key, now_s, until_s - now_s)
        .add_extension(x509.SubjectAlternativeName([_general_name(name) for name in names]), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(digital_signature=True), critical=True)
        .add_extension(x509.ExtendedKeyUsage([x509.oid.ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(signing_key.public_key()), critical=False
        )
    )
    return _sign(builder, key, signing_key)


def _builder(subject: Any, issuer: Any, key: Any, now_s: float, valid_s: float) -> Any:
    x509, _, _ = _cryptography()
    utc = datetime.timezone.utc
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime.datetime.fromtimestamp(now_s - _EARLIER_S, utc))
        .not_valid_after(datetime.datetime.fromtimestamp(now_s + valid_s, utc))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _sign(builder: Any, key: Any, signing_key: Any) -> CertificateWithKey:
    _, _, serialization = _cryptography()
    from cryptography.hazmat.primitives import hashes

    pem, pkcs8 = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    return CertificateWithKey(
        certificate=builder.sign(signing_key, hashes.SHA256()).public_bytes(pem).decode("ascii"),
        private_key=key.private_bytes(pem, pkcs8, serialization.NoEncryption()).decode("ascii"),
    )


def _usage(**allowed: bool) -> Any:
    x509, _, _ = _cryptography()
    kinds = (
        "digital_signature", "content_commitment", "key_encipherment", "data_encipherment", "key_agreement",
        "key_cert_sign", "crl_sign", "encipher_only", "decipher_only",
    )  # fmt: skip
    return x509.KeyUsage(**{kind: allowed.get(kind, False) for kind in kinds})


def _subject(name: str) -> Any:
    x509, _, _ = _cryptography()
    return x509.Name([x509.NameAttribute(x509.oid.NameOID.COMMON_NAME, name)])


def _general_name(name: str) -> Any:
    x509, _, _ = _cryptography()
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)


def _cryptography() -> tuple[Any, Any, Any]:
    """Return the modules x509, ec and serialization; raises MissingExtra."""
    try:
        from cryptography import x509
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ec
    except ImportError as error:
        raise MissingExtra("cryptography", "keys") from error
    return x509, ec, serialization
