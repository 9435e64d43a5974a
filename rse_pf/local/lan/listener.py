"""Make and renew the certificates of the listener for other machines of the network.

In the platform's state folder, ``authority.pem`` holds a certificate authority with its private key, which is
kept over restarts.  ``tls.json``, which Envoy watches, holds the listener's certificate and key, and is
replaced before the certificate expires.  Both files can be read by the operator's user only.
``authority.crt`` is the certificate of the authority without its key, for robots and browsers.
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
"""Name under which Envoy's configuration refers to the certificate in ``tls.json``."""
# A certificate is replaced when it expires within this time, in seconds: a third of a server certificate's
# validity.
_RENEW_S = SERVER_S / 3
# Time between two checks of the certificate, in seconds.
_CHECK_EVERY_S = 3600.0
_LOOPBACK = "127.0.0.1"
_HINT = "remove the file; robots must be enrolled again"


def authority_file(folder: Path) -> Path:
    """Return the path of the certificate, without key, of the authority of the platform in *folder*."""
    return folder / "authority.crt"


def secret_file(folder: Path) -> Path:
    """Return the path from which Envoy reads certificate and key of the listener."""
    return folder / "tls.json"


def secret_document(server: CertificateWithKey) -> dict[str, Any]:
    """Return the content of ``tls.json`` as plain JSON values: certificate and key of *server*.

    Both are in one file, so that they change in one step.
    """
    kind = "type.googleapis.com/envoy.extensions.transport_sockets.tls.v3.Secret"
    certificate = {
        "certificate_chain": {"inline_string": server.certificate},
        "private_key": {"inline_string": server.private_key},
    }
    return {"resources": [{"@type": kind, "name": CERTIFICATE_NAME, "tls_certificate": certificate}]}


@dataclass(frozen=True, slots=True, kw_only=True)
class LanListener:
    """The address of the listener, and the state folder of the platform; `prepare` makes its files."""

    address: str
    folder: Path

    @property
    def names(self) -> tuple[str, ...]:
        """The subjects of the certificate: the address, the host names of this machine, and 127.0.0.1."""
        return (self.address, *host_names(), _LOOPBACK)

    def prepare(self, platform: str, *, now_s: float) -> bool:
        """Make the authority and the certificate if they are missing or expire soon.

        A certificate for other names, or of another authority, is replaced, too.  Returns whether the
        certificate is new.

        Args:
            platform: Name of the platform, for the authority's certificate.
            now_s: The present time, Unix seconds.

        Raises:
            ConfigurationError: The file of the authority cannot be read, is damaged, or other users may read
                it; or a file cannot be written.
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
        """Return the authority with its key; raises UsageError if its file is missing or damaged."""
        path = self.folder / "authority.pem"
        text = read_private_file(path, "the authority", hint=_HINT).decode("utf-8", "replace")
        try:
            return CertificateWithKey.from_pem(text)
        except UsageError as error:
            raise UsageError(f"{path}: {error.message}", hint=error.hint) from error

    async def keep_valid(
        self, platform: str, renewed: Callable[[], None], problem: Callable[[str], None]
    ) -> None:
        """Renew the certificate before it expires, until cancelled; it is checked once an hour.

        *renewed* is called after each renewal, and *problem* with a sentence after each one that failed.
        """
        while True:
            await asyncio.sleep(_CHECK_EVERY_S)
            try:
                if self.prepare(platform, now_s=time.time()):
                    renewed()
            except ConfigurationError as error:
                problem(f"the certificate is not renewed yet: {error.message}")

    def _authority(self, platform: str, now_s: float) -> tuple[CertificateWithKey, bool]:
        """Return the authority, made if it is missing or expires soon, and whether it was made now."""
        path = self.folder / "authority.pem"
        is_new = not path.exists() or self.authority().expires_s - now_s < _RENEW_S
        if is_new:
            replace_file(path, make_authority(platform, now_s=now_s).pem, mode=OWNER_ONLY, is_durable=True)
        authority = self.authority()
        if is_new or not authority_file(self.folder).exists():
            replace_file(authority_file(self.folder), authority.certificate)
        return authority, is_new

    def _read_certificate(self) -> CertificateWithKey | None:
        """Return the certificate in ``tls.json``; None if the file is missing or damaged."""
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
