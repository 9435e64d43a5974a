"""Decide which settings of a running platform a roll can change.

A roll replaces backend servers, data server and rosbridge server, which read the settings at their start.
The control plane and the load balancer keep the settings that they were started with.  All functions are
pure.
"""

from __future__ import annotations

from dataclasses import dataclass

from rse_pf.config import PlatformSettings, setting_rows
from rse_pf.errors import UsageError

__all__ = ["SettingsChange", "settings_change"]

_UNUSED = (
    "batch.", "cloud.", "serving.port", "serving.control_port", "serving.control_host", "data.port",
    "data.host",
)  # fmt: skip
"""Groups and settings whose changes are ignored: no process of a local platform reads them."""
_OF_OPTIONS = frozenset(
    (
        "local.servers", "local.port", "local.metrics_port", "recording.folder", "services.folder",
        "services.accept_weak_isolation", "serving.rosbridge", "burst.url",
    )
)  # fmt: skip
"""Settings that options of rse-pf local may have set: they stay if the file of the roll has the default."""
_KEPT_UNTIL_RESTART = (
    "local.", "scaling.", "health.", "recording.", "data.store", "serving.host", "serving.rosbridge",
    "session.hello_timeout_s", "session.ping_interval_s", "session.ping_timeout_s",
)  # fmt: skip
"""Groups and settings that need a restart of the platform: control plane or load balancer reads them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingsChange:
    """The settings after a roll, and one line of text for each change and each setting that stays."""

    settings: PlatformSettings
    words: tuple[str, ...]


def settings_change(running: PlatformSettings, wanted: PlatformSettings) -> SettingsChange:
    """Return what a roll changes in a platform with the settings *running*, by a file with those *wanted*.

    Raises:
        UsageError: Nothing changes, or a change needs a restart of the platform.
    """
    before = _values(running)
    defaults = _values(PlatformSettings())
    others = {
        name: value
        for name, value in _values(wanted).items()
        if value != before[name] and not name.startswith(_UNUSED)
    }
    unset = [name for name, value in others.items() if name in _OF_OPTIONS and value == defaults[name]]
    changed = {name: value for name, value in others.items() if name not in unset}
    if not changed:
        raise UsageError(
            "the file changes no setting of the platform that runs: no server was replaced",
            hint="leave --settings out to replace the servers as they are",
        )
    kept = [name for name in changed if name.startswith(_KEPT_UNTIL_RESTART)]
    if kept:
        raise UsageError(
            f"{', '.join(kept)} {'needs' if len(kept) == 1 else 'need'} a restart of the platform",
            hint="take the change out of the file and roll with the others, or see docs/howto/upgrade.md",
        )
    groups: dict[str, dict[str, object]] = {}
    for name, value in changed.items():
        group, _, setting = name.partition(".")
        groups.setdefault(group, {})[setting] = value
    words = [f"{name} = {value!r} (was {before[name]!r})" for name, value in changed.items()]
    words += [f"{name} stays {before[name]!r}, which the file does not set" for name in unset]
    return SettingsChange(settings=running.replace(**groups), words=tuple(words))


def _values(settings: PlatformSettings) -> dict[str, object]:
    """Return the value of each setting, by ``group.name``."""
    return {f"{row.group}.{row.name}": row.value for row in setting_rows(settings)}
