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
"""Fields that are no settings of the group serving: their groups and names there."""
_FILE_KEY = "placement"


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerPlacement:
    """The addresses, processes and object store of one backend server.

    Each field is a setting of the same name of the group serving, but for ``store`` (data.store) and
    ``live_host`` (live.host); port 0 takes a free one, workers 0 means one for each core.
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
        """Return the placement that *settings* describe, with *changes*; raises SettingsError."""
        placed = _placed(settings, changes)
        groups = {name: _ELSEWHERE.get(name, ("serving", name)) for name in cls.__slots__}
        return cls(**{name: getattr(getattr(placed, group), of) for name, (group, of) in groups.items()})

    @classmethod
    def read(cls, file: Path | None, settings: PlatformSettings, **changes: Any) -> ServerPlacement:
        """Return the placement in a settings file with *changes*; *settings* say the rest.

        Raises:
            SettingsError: The file cannot be read, or holds a value that no such setting may have.
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
        """Return *settings* as they are for this server."""
        return _placed(settings, asdict(self))

    def document(self, settings: PlatformSettings) -> dict[str, Any]:
        """Return the content of a settings file for servers with this placement, as plain JSON values."""
        return {"context": {"rse-pf": settings.to_dict()}, _FILE_KEY: asdict(self)}


def live_ports(live: LiveSettings) -> range:
    """Return the ports on which the map servers of live maps listen on ``live.host``; 0 takes a free one.

    If other machines connect, the ports are fixed, so that a firewall can name them.
    """
    if is_loopback(live.host) or not live.first_port:
        return range(1)
    return fixed_live_ports(live)


def fixed_live_ports(live: LiveSettings) -> range:
    """Return the ports of `live_ports` where other machines connect; ``live.first_port`` is not 0."""
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
    groups: dict[str, dict[str, Any]] = {}
    for name, value in changes.items():
        group, of = _ELSEWHERE.get(name, ("serving", name))
        groups.setdefault(group, {})[of] = value
    return settings.replace(**groups)
