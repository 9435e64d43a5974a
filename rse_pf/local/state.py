"""The state folder of a local platform, and its state file ``platform.json``, which other commands read.

There is one folder for each platform name under ``$XDG_STATE_HOME/rse-pf``.  The state file exists while a
process of the platform runs, and holds no secret: key and token have files of their own.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import signal
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings, load_settings
from rse_pf.errors import ConfigurationError, SettingsError, UsageError
from rse_pf.local.processes import STOP_TIMEOUT_S, ProcessMark, is_alive, send_signal, wait_ended
from rse_pf.storage.files import replace_file

__all__ = [
    "PlatformLock",
    "PlatformState",
    "ServerState",
    "control_token_file",
    "platform_settings",
    "read_state",
    "recording_key_file",
    "remove_keys",
    "remove_state",
    "settings_file",
    "state_file",
    "state_folder",
    "stop_platform",
]

# Name of the state file in a platform's folder.
_FILE = "platform.json"
# Name of the file in a platform's folder whose lock the control plane holds.
_LOCK = "lock"
_OPTIONAL = ("lan", "authority_file", "rosbridge_server")
"""Fields of `PlatformState` that the file has only if they are set: earlier versions refuse new fields."""
# A valid name of a platform.
_NAME = re.compile(r"[a-z0-9][a-z0-9-]{0,31}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerState:
    """One server of any kind in the state file; its ports are 0 until it has announced them."""

    name: str
    process: ProcessMark
    port: int = 0
    control_port: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class PlatformState:
    """The state of a platform that runs, as in its state file.

    ``url`` is the address that robots connect to, "" until they can; ``port`` is its port.  ``status_port``
    is the operator's port of the control plane on loopback.  ``launched`` is the highest number N of a
    server's name ``server-N`` so far.  ``control_token_file`` is "" if the control ports require no token.
    ``lan`` is the address at which other machines connect, "" if none can; ``authority_file`` is then the
    certificate of the authority that they trust.
    """

    name: str
    control_plane: ProcessMark
    url: str
    settings_digest: str
    settings_file: str
    key_file: str
    control_token_file: str = ""
    servers: tuple[ServerState, ...] = ()
    data_server: ServerState | None = None
    rosbridge_server: ServerState | None = None
    load_balancer: ProcessMark | None = None
    port: int = 0
    status_port: int = 0
    launched: int = 0
    lan: str = ""
    authority_file: str = ""

    def processes(self) -> tuple[ProcessMark, ...]:
        """Return the marks of all processes of the platform except for the control plane."""
        balancer = () if self.load_balancer is None else (self.load_balancer,)
        return (*(server.process for server in (*self.servers, *self.single_servers)), *balancer)

    @property
    def single_servers(self) -> tuple[ServerState, ...]:
        """The data server and the rosbridge server, as far as they exist."""
        both = (self.data_server, self.rosbridge_server)
        return tuple(server for server in both if server is not None)

    def write(self, folder: Path) -> None:
        """Replace the state file in *folder* in one step."""
        replace_file(state_file(folder), self.to_json())

    def to_json(self) -> str:
        """Return the content of the state file."""
        document = asdict(self)
        for name in _OPTIONAL:
            if not document[name]:
                del document[name]
        return json.dumps(document, indent=2) + "\n"


class PlatformLock:
    """The lock that lets at most one control plane use a folder.

    Linux releases it when the process that holds it exits, for whatever reason.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / _LOCK
        self._fd = -1

    def take(self, name: str) -> None:
        """Take the lock; raises ConfigurationError if another process holds it.

        *name* is the platform's name in the error message.
        """
        fd = os.open(self._path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(fd)
            raise ConfigurationError(
                f"a platform named {name!r} is running already",
                hint=f"end it with: rse-pf local stop --name {name}, or choose another --name",
            ) from error
        self._fd = fd

    def release(self) -> None:
        """Release the lock, if it was taken."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


def state_folder(name: str, environment: Mapping[str, str]) -> Path:
    """Return the state folder of the platform called *name*; it need not exist.

    Args:
        name: Name of the platform.
        environment: Environment variables, of which XDG_STATE_HOME and HOME count.

    Raises:
        UsageError: The name is not made of 1 to 32 lower-case letters, digits and hyphens.
    """
    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{name[:80]!r} is no name for a platform", hint="use 1 to 32 small letters, digits and hyphens"
        )
    base = Path(environment.get("XDG_STATE_HOME", ""))
    if not base.is_absolute():
        base = Path(environment.get("HOME") or "~").expanduser() / ".local" / "state"
    return base / "rse-pf" / name


def control_token_file(folder: Path) -> Path:
    """Return the path of the token that the control ports of the platform in *folder* require."""
    return folder / "control.token"


def recording_key_file(folder: Path) -> Path:
    """Return the path of the key with which recordings replace names by pseudonyms.

    The file exists while the platform records; its servers then get it as --record-key.
    """
    return folder / "recording.key"


def settings_file(folder: Path) -> Path:
    """Return the path of the settings that the servers of the platform in *folder* read."""
    return folder / "settings.json"


def platform_settings(folder: Path) -> PlatformSettings | None:
    """Return the settings that the platform in *folder* was started with; None if it never was started.

    Raises:
        ConfigurationError: The file is damaged, or of a version whose settings had other names.
    """
    file = settings_file(folder)
    try:
        return load_settings(file) if file.exists() else None
    except SettingsError as error:
        raise ConfigurationError(
            f"{file} is not of this version: {error.message}",
            hint=f"start the platform once with: rse-pf local --name {folder.name}",
        ) from error


def state_file(folder: Path) -> Path:
    """Return the path of the state file of the platform in *folder*."""
    return folder / _FILE


def read_state(folder: Path) -> PlatformState | None:
    """Return the content of the state file in *folder*; None if there is no such file.

    A platform whose processes were all killed may have left the file.

    Raises:
        ConfigurationError: The file cannot be read, or is damaged.
    """
    path = folder / _FILE
    try:
        return _state(json.loads(path.read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(
            f"{path} cannot be read: {error}", hint="end its processes by hand, then remove the file"
        ) from error


def remove_state(folder: Path) -> None:
    """Remove the state file in *folder*, if it exists; keys and logs stay."""
    (folder / _FILE).unlink(missing_ok=True)


def remove_keys(folder: Path) -> None:
    """Delete the signing keys of a stopped platform and of its live maps in *folder*."""
    for pattern in ("key*.json", "objects/live/key=*"):
        for file in folder.glob(pattern):
            file.unlink()


def stop_platform(folder: Path, timeout_s: float = STOP_TIMEOUT_S) -> bool:
    """Stop all processes of the platform in *folder*; return whether any ran.

    The control plane gets SIGTERM first, and stops its servers itself.  Processes that then still run, also
    those of a control plane that was killed, get SIGINT.  A process that has not exited after *timeout_s*
    (the control plane: three times that) is killed.  Only processes whose id and start time are in the state
    file are signalled; the file is removed.

    Raises:
        ConfigurationError: The state file cannot be read, or is damaged.
    """
    state = read_state(folder)
    if state is None:
        return False
    ran = send_signal(state.control_plane, signal.SIGTERM)
    # The control plane waits for the rosbridge server, the other servers and the balancer, one after the
    # other.
    if ran and not wait_ended(state.control_plane, 3 * timeout_s):
        send_signal(state.control_plane, signal.SIGKILL)
        wait_ended(state.control_plane, timeout_s)
    remaining = [mark for mark in (read_state(folder) or state).processes() if is_alive(mark)]
    for mark in remaining:
        send_signal(mark, signal.SIGINT)
    for mark in remaining:
        if not wait_ended(mark, timeout_s):
            send_signal(mark, signal.SIGKILL)
            wait_ended(mark, timeout_s)
    remove_state(folder)
    return ran or bool(remaining)


def _state(document: Any) -> PlatformState:
    if not isinstance(document, dict):
        raise TypeError("it holds no JSON object")
    balancer = document.pop("load_balancer")
    servers = tuple(map(_server, document.pop("servers")))
    data, rosbridge = document.pop("data_server", None), document.pop("rosbridge_server", None)
    return PlatformState(
        **{**document, "control_plane": ProcessMark(**document["control_plane"])},
        servers=servers,
        data_server=None if data is None else _server(data),
        rosbridge_server=None if rosbridge is None else _server(rosbridge),
        load_balancer=None if balancer is None else ProcessMark(**balancer),
    )


def _server(document: dict[str, Any]) -> ServerState:
    return ServerState(**{**document, "process": ProcessMark(**document["process"])})
