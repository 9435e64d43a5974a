"""The listener for other machines of the network: its address, and the files of its certificates.

``authority.pem`` in the platform's folder holds the authority with its key and stays; the certificate of the
listener is in the file that Envoy watches, and is replaced before it expires, while the platform runs.  Both
hold a private key and can be read by their owner only.  ``authority.crt`` is the public half, for browsers.
"""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rse_pf.auth.certificates import (
    SERVER_S,
    CertificateWithKey,
    issue_server_certificate,
    make_authority,
)
from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.local.lan.addresses import host_names
from rse_pf.storage.files import OWNER_ONLY, read_private_file, replace_file

__all__ = ["CERTIFICATE_NAME", "LanListener", "authority_file", "secret_document", "secret_file"]

CERTIFICATE_NAME = "front-door"
"""Name of the listener's certificate in Envoy's file."""
# A certificate is renewed when it is valid for less than this, in seconds.
_RENEW_S = SERVER_S / 3
# Time between two checks of the certificate, in seconds.
_CHECK_EVERY_S = 3600.0
_LOOPBACK = "127.0.0.1"
_HINT = "remove the file; robots must be enrolled again"


def authority_file(folder: Path) -> Path:
    """Return the file of the public certificate of the authority of the platform in *folder*."""
    return folder / "authority.crt"


def secret_file(folder: Path) -> Path:
    """Return the file from which Envoy reads certificate and key."""
    return folder / "tls.json"


def secret_document(server: CertificateWithKey) -> dict[str, Any]:
    """Return Envoy's file with *server*, certificate and key in one, so that both change in one step."""
    kind = "type.googleapis.com/envoy.extensions.transport_sockets.tls.v3.Secret"
    certificate = {
        "certificate_chain": {"inline_string": server.certificate},
        "private_key": {"inline_string": server.private_key},
    }
    return {"resources": [{"@type": kind, "name": CERTIFICATE_NAME, "tls_certificate": certificate}]}


@dataclass(frozen=True, slots=True, kw_only=True)
class LanListener:
    """The address of the listener, and the folder of the platform; `prepare` makes the files."""

    address: str
    folder: Path

    @property
    def names(self) -> tuple[str, ...]:
        """The subjects of the certificate: the address, and the names of this machine."""
        return (self.address, *host_names(), _LOOPBACK)

    def prepare(self, platform: str, *, now_s: float) -> bool:
        """Make what is missing, expires soon or is for another address; return whether anything changed.

        Args:
            platform: Name of the platform, for the authority's certificate.
            now_s: Unix seconds.

        Raises:
            ConfigurationError: The file of the authority cannot be read, is damaged, or others may read it;
                a file cannot be written.
        """
        try:
            return self._prepare(platform, now_s)
        except UsageError as error:
            raise ConfigurationError(error.message, hint=error.hint) from error
        except OSError as error:
            raise ConfigurationError(
                f"the certificates cannot be written: {error.strerror}", hint="free some space"
            ) from error

    def _prepare(self, platform: str, now_s: float) -> bool:
        authority, is_new = self._authority(platform, now_s)
        current = None if is_new else self._read_certificate()
        if (
            current is not None
            and set(current.names) == set(self.names)
            and current.expires_s - now_s > _RENEW_S
            and current.is_issued_by(authority)
        ):
            return False
        server = issue_server_certificate(authority, self.names, now_s=now_s)
        replace_file(secret_file(self.folder), json.dumps(secret_document(server)), mode=OWNER_ONLY)
        return True

    def authority(self) -> CertificateWithKey:
        """Return the authority; raises UsageError."""
        path = self.folder / "authority.pem"
        text = read_private_file(path, "the authority", hint=_HINT).decode("utf-8", "replace")
        try:
            return CertificateWithKey.from_pem(text)
        except UsageError as error:
            raise UsageError(f"{path}: {error.message}", hint=error.hint) from error

    async def keep_valid(
        self, platform: str, renewed: Callable[[], None], problem: Callable[[str], None]
    ) -> None:
        """Renew the certificate before it expires, until cancelled; *problem* gets why that failed."""
        while True:
            await asyncio.sleep(_CHECK_EVERY_S)
            try:
                if self.prepare(platform, now_s=time.time()):
                    renewed()
            except ConfigurationError as error:
                problem(f"the certificate is not renewed yet: {error.message}")

    def _authority(self, platform: str, now_s: float) -> tuple[CertificateWithKey, bool]:
        path = self.folder / "authority.pem"
        is_new = not path.exists() or self.authority().expires_s - now_s < _RENEW_S
        if is_new:
            replace_file(path, make_authority(platform, now_s=now_s).pem, mode=OWNER_ONLY, is_durable=True)
        authority = self.authority()
        if is_new or not authority_file(self.folder).exists():
            replace_file(authority_file(self.folder), authority.certificate)
        return authority, is_new

    def _read_certificate(self) -> CertificateWithKey | None:
        """Return the certificate that Envoy has; None if there is none that can be used."""
        path = secret_file(self.folder)
        try:
            document = json.loads(read_private_file(path, "the certificate", hint=_HINT))
            certificate = document["resources"][0]["tls_certificate"]
            return CertificateWithKey.from_pem(
                certificate["certificate_chain"]["inline_string"]
                + certificate["private_key"]["inline_string"]
            )
        except (UsageError, ValueError, KeyError, IndexError, TypeError):
            return None
