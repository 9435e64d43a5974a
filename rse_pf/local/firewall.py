"""The firewall box on one machine: checks of the listener for robots, and the key that signs their tokens.

Robots connect on loopback, or, if an operator asks for it with --lan, at an address of the network, by TLS
and with tokens.  The private key is in a file that only the operator's user can read.
"""

from __future__ import annotations

import errno
import socket
from pathlib import Path

from rse_pf.auth.tokens import KeySet, SigningKey
from rse_pf.config import PlatformSettings
from rse_pf.config.placement import is_loopback
from rse_pf.config.resource_names import ROBOTS_PATH
from rse_pf.errors import ConfigurationError, UsageError
from rse_pf.local.lan.listener import LanListener
from rse_pf.storage.files import OWNER_ONLY, read_private_file, replace_file

__all__ = [
    "check_lan_settings", "check_listener", "ensure_key", "key_file", "key_set_file", "read_key",
    "robots_url",
]  # fmt: skip


def key_file(folder: Path) -> Path:
    """Return the path of the private key of the platform in *folder*; the file need not exist."""
    return folder / "key.json"


def key_set_file(folder: Path) -> Path:
    """Return the path of the platform's public keys, a JWKS that its servers read; it need not exist."""
    return folder / "keys.json"


def robots_url(settings: PlatformSettings, port: int, lan: LanListener | None = None) -> str:
    """Return the address that robots connect to, at *port*.

    It begins with ``wss://`` if there is a *lan* listener or ``local.certificate``, else with ``ws://``.
    *lan* also gives the host, in place of ``serving.host``.
    """
    address = settings.serving.host if lan is None else lan.address
    host = f"[{address}]" if ":" in address else address
    scheme = "wss" if settings.local.certificate or lan is not None else "ws"
    return f"{scheme}://{host}:{port}{ROBOTS_PATH}"


def check_listener(host: str, port: int, *, is_protected: bool = False) -> None:
    """Refuse a listener that other machines could reach without protection, or whose port is taken.

    Args:
        host: Address of this machine on which to listen.
        port: Port on which to listen; 0, any free one, is never taken.
        is_protected: Whether the listener has TLS and requires tokens (`check_lan_settings`), so that other
            machines may reach it.

    Raises:
        ConfigurationError: *host* is neither a loopback address nor protected, it is no address of this
            machine, or another program listens on *port*.
    """
    if not is_protected and not is_loopback(host):
        raise ConfigurationError(
            f"serving.host = {host} would open the local platform to other machines",
            hint="set serving.host to 127.0.0.1; rse-pf local --lan opens it with certificate and tokens",
        )
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((host, port))
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                raise ConfigurationError(
                    f"{host} is no address of this machine", hint="ip address shows those that it has"
                ) from error
            raise ConfigurationError(
                f"cannot listen on {host}:{port}: {error.strerror}",
                hint="choose another port with --port; --port 0 takes a free one",
            ) from error


def check_lan_settings(settings: PlatformSettings) -> None:
    """Refuse settings with which the platform must not be opened to other machines by --lan.

    Raises:
        ConfigurationError: ``auth.required`` is off, or ``local.certificate`` is set: --lan makes its own.
    """
    if not settings.auth.required:
        raise ConfigurationError(
            "auth.required = false would open the platform to every machine of the network",
            hint="remove auth.required from the settings, or leave --lan out",
        )
    if settings.local.certificate:
        raise ConfigurationError(
            "--lan makes a certificate of its own, and local.certificate is set",
            hint="remove local.certificate and local.private_key from the settings",
        )


def ensure_key(folder: Path, *, seed: bytes, key_id: str) -> SigningKey:
    """Return the signing key of the platform in *folder*, and write its key files as far as they are missing.

    A platform that starts again keeps its keys, so that the tokens of robots stay valid.  The set of public
    keys is written anew only if it lacks the signing key; after a rotation it also holds the key before.

    Args:
        folder: State folder of the platform.
        seed: 32 secret random bytes, from which a missing key is made.
        key_id: Id of a key that is made.
    """
    path = key_file(folder)
    if not path.exists():
        replace_file(path, SigningKey.from_seed(seed, key_id).to_json(), mode=OWNER_ONLY)
    key = read_key(path)
    public = key_set_file(folder)
    if _holds_key(public, key):
        return key
    replace_file(public, key.key_set().to_json())
    return key


def _holds_key(public: Path, key: SigningKey) -> bool:
    """Return whether the set of public keys in the file *public* holds *key*; False if it is unreadable."""
    try:
        public_key = KeySet.from_json(public.read_text(encoding="utf-8")).get(key.key_id)
    except (OSError, UsageError):
        return False
    own = key.key_set().get(key.key_id)
    return (
        public_key is not None and own is not None and public_key.public_bytes_raw() == own.public_bytes_raw()
    )


def read_key(path: Path) -> SigningKey:
    """Return the private signing key in the file *path*.

    Raises:
        UsageError: There is no such file, other users may read it, or it holds no signing key.
    """
    hint = "start a platform with rse-pf local, name the one that runs with --name, or a key with --key"
    return SigningKey.from_json(read_private_file(path, "the key", hint=hint))
