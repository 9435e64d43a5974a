"""The firewall box on one machine: what may be listened on, and the key that signs robots' tokens.

The listener is on loopback, or, if an operator asks for it, on an address of the network, by TLS and with
tokens.  The private key is in a file that only its owner can read.
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
    """Return the file of the private key of the platform in *folder*."""
    return folder / "key.json"


def key_set_file(folder: Path) -> Path:
    """Return the file of the public keys of the platform in *folder*, a JWKS, for its servers."""
    return folder / "keys.json"


def robots_url(settings: PlatformSettings, port: int, lan: LanListener | None = None) -> str:
    """Return the address that robots connect to: ``ws://``, or ``wss://`` if there is a certificate."""
    address = settings.serving.host if lan is None else lan.address
    host = f"[{address}]" if ":" in address else address
    scheme = "wss" if settings.local.certificate or lan is not None else "ws"
    return f"{scheme}://{host}:{port}{ROBOTS_PATH}"


def check_listener(host: str, port: int, *, is_protected: bool = False) -> None:
    """Refuse a listener that other machines could reach, or whose port is taken.

    Args:
        host: An address of this machine.
        port: 0 is always free.
        is_protected: Whether it has TLS and requires tokens (`check_lan_settings`), so that others may
            reach it.

    Raises:
        ConfigurationError: *host* is not a loopback address and not protected, it is no address of this
            machine, or something listens on *port*.
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
                    f"{host} is no address of this machine", hint="ip address shows them"
                ) from error
            raise ConfigurationError(
                f"cannot listen on {host}:{port}: {error.strerror}",
                hint="choose another port with --port; --port 0 takes a free one",
            ) from error


def check_lan_settings(settings: PlatformSettings) -> None:
    """Refuse settings under which no other machine may reach the platform.

    Raises:
        ConfigurationError: Robots need no token, or the listener has a certificate from elsewhere.
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
    """Return the key of *folder*; make it from *seed* (32 secret random bytes) if there is none.

    A platform that starts again keeps its keys, so that robots keep their tokens: a set that a rotation wrote
    and that holds the newest key stays as it is.
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
    """Return whether the set in the file *public* holds *key*."""
    try:
        public_key = KeySet.from_json(public.read_text(encoding="utf-8")).get(key.key_id)
    except (OSError, UsageError):
        return False
    own = key.key_set().get(key.key_id)
    return (
        public_key is not None and own is not None and public_key.public_bytes_raw() == own.public_bytes_raw()
    )


def read_key(path: Path) -> SigningKey:
    """Return the key in *path*.

    Raises:
        UsageError: There is no such file, others may read it, or it holds no signing key.
    """
    hint = "start a platform with rse-pf local, name the one that runs with --name, or a key with --key"
    return SigningKey.from_json(read_private_file(path, "the key", hint=hint))
