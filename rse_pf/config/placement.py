"""The placement of one server: the settings that differ between servers of the same platform.

A settings file may hold a placement next to the settings, for the servers of one machine; options of
``rse-pf serve`` override it.  The digest of the settings does not depend on it.
"""

from __future__ import annotations

import ipaddress
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rse_pf.config.settings import LIVE_PORTS, LiveSettings, PlatformSettings
from rse_pf.errors import SettingsError

__all__ = ["ServerPlacement", "fixed_live_ports", "is_loopback", "live_ports"]

_ELSEWHERE = {"store": ("data", "store"), "live_host": ("live", "host")}
"""Group and name of the setting of each placement field that is not in the group ``serving``."""
# Member of a settings file that holds a placement.
_FILE_KEY = "placement"


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerPlacement:
    """The addresses, processes and object store of one backend server.

    Each field replaces the setting with its name in the group ``serving``, except ``store`` (``data.store``)
    and ``live_host`` (``live.host``).  Port 0 takes a free port; 0 workers are one worker for each core.
    """

    host: str
    port: int
    control_host: str
    control_port: int
    workers: int
    store: str
    live_host: str

    @classmethod
    def of(cls, settings: PlatformSettings, **changes: Any) -> ServerPlacement:
        """Return the placement in *settings*, with the fields in *changes* replaced; raises SettingsError."""
        placed = _placed(settings, changes)
        groups = {name: _ELSEWHERE.get(name, ("serving", name)) for name in cls.__slots__}
        return cls(**{name: getattr(getattr(placed, group), of) for name, (group, of) in groups.items()})

    @classmethod
    def read(cls, file: Path | None, settings: PlatformSettings, **changes: Any) -> ServerPlacement:
        """Return the placement in the settings file *file*, with the fields in *changes* replaced.

        A field that neither the file nor *changes* holds has its value in *settings*; without *file*, so do
        all fields that are not in *changes*.

        Raises:
            SettingsError: The file cannot be read, has an unknown field, or holds a value that its setting
                may not have.
        """
        if file is None:
            return cls.of(settings, **changes)
        try:
            document = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise SettingsError(f"cannot read {file}: {error}", hint="name another file") from error
        placed = document.get(_FILE_KEY, {})
        unknown = set(placed) - set(cls.__slots__) if isinstance(placed, dict) else {_FILE_KEY}
        if unknown:
            raise SettingsError(
                f"{file}: placement has no {min(unknown)!r}", hint=f"it takes {', '.join(cls.__slots__)}"
            )
        return cls.of(settings, **{**placed, **changes})

    def apply(self, settings: PlatformSettings) -> PlatformSettings:
        """Return *settings* with the values of this placement, as the server itself uses them."""
        return _placed(settings, asdict(self))

    def document(self, settings: PlatformSettings) -> dict[str, Any]:
        """Return the content of a settings file with *settings* and this placement, as plain JSON values."""
        return {"context": {"rse-pf": settings.to_dict()}, _FILE_KEY: asdict(self)}


def live_ports(live: LiveSettings) -> range:
    """Return the ports among which each map server of a live map chooses one on ``live.host``.

    If ``live.host`` is a loopback address, or ``live.first_port`` is 0, the only entry is port 0: any free
    port.  Otherwise the ports are fixed, so that a firewall can name them.
    """
    if is_loopback(live.host) or not live.first_port:
        return range(1)
    return fixed_live_ports(live)


def fixed_live_ports(live: LiveSettings) -> range:
    """Return the `LIVE_PORTS` ports from ``live.first_port`` on, for servers that other machines connect to.

    ``live.first_port`` must not be 0.
    """
    return range(live.first_port, live.first_port + LIVE_PORTS)


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach *host*: a loopback address, or the name ``localhost``.

    Source:
        RFC 6761, Sect. 6.3: the name ``localhost`` always means a loopback address.
    """
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _placed(settings: PlatformSettings, changes: dict[str, Any]) -> PlatformSettings:
    """Return *settings* with the placement fields *changes*, by name; raises SettingsError."""
    groups: dict[str, dict[str, Any]] = {}
    for name, value in changes.items():
        group, of = _ELSEWHERE.get(name, ("serving", name))
        groups.setdefault(group, {})[of] = value
    return settings.replace(**groups)
