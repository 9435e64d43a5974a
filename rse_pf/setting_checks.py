"""Refuse a setting of the wrong type, out of its range, or in contradiction to another one.

The rows themselves are in `rse_pf.settings`.  Promises to name the setting, both numbers, and what to do.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from rse_pf.errors import SettingsError

if TYPE_CHECKING:
    from rse_pf.settings import PlatformSettings, SettingRow

__all__ = ["check_contradictions", "check_range", "did_you_mean", "typed"]

_LARGEST = 1e15
_WHERE = 'in cdk.json, context."rse-pf"'


def typed(name: str, value: Any, kind: Any) -> Any:
    """Return *value* as *kind*, a whole number as a float where one is meant; raises SettingsError."""
    if kind in (int, float) and type(value) in (int, float) and not abs(value) <= _LARGEST:
        raise SettingsError(f"{name} is not a finite number below {_LARGEST:g}", hint=f"mend it {_WHERE}")
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise SettingsError(
            f"{name} = {_shown(value)} is not of type {kind.__name__}", hint=f"mend it {_WHERE}"
        )
    return value


def _shown(value: Any) -> str:
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        text = type(value).__name__
    return text if len(text) <= 80 else f"{text[:77]}..."


def check_range(row: SettingRow) -> None:
    """Raise SettingsError if the value of *row* is not among its choices or out of its range."""
    where = _WHERE
    if row.choices and row.value not in row.choices:
        raise SettingsError(
            f"{row.group}.{row.name} = {row.value!r} is not one of {', '.join(row.choices)}",
            hint=f"choose one of them {where}",
        )
    if row.low is not None and not row.value >= row.low:
        raise SettingsError(
            f"{row.group}.{row.name} = {row.value} is below {row.low:g}", hint=f"raise it {where}"
        )
    if row.high is not None and not row.value <= row.high:
        raise SettingsError(
            f"{row.group}.{row.name} = {row.value} is above {row.high:g}", hint=f"lower it {where}"
        )


def check_contradictions(s: PlatformSettings) -> None:
    """Raise SettingsError if two settings cannot both hold."""
    where = _WHERE
    pairs = [
        ("scaling", "min_servers", "max_servers"),
        ("scaling", "busy_cpu_percent", "very_busy_cpu_percent"),
        ("scaling", "idle_cpu_percent", "busy_cpu_percent"),
        ("scaling", "step", "big_step"),
        ("session", "max_message_bytes", "max_inflated_bytes"),
        ("session", "reconnect_base_s", "reconnect_max_s"),
        ("pnp", "min_iterations", "max_iterations"),
        ("health", "cloud_timeout_s", "cloud_interval_s"),
        ("data", "infrequent_after_days", "glacier_after_days"),
    ]
    for group, small, large in pairs:
        low, high = (getattr(getattr(s, group), name) for name in (small, large))
        if low > high:
            raise SettingsError(
                f"{group}.{large} = {high:g} is less than {group}.{small} = {low:g}",
                hint=f"raise {group}.{large} or lower {group}.{small} {where}",
            )
    if bool(s.local.certificate) != bool(s.local.private_key):
        raise SettingsError(
            f"local.certificate = {s.local.certificate!r} without its fellow, local.private_key = "
            f"{s.local.private_key!r}",
            hint=f"name both files, or none of them {where}",
        )
    if s.scaling.idle_s % s.scaling.period_s:
        raise SettingsError(
            f"scaling.idle_s = {s.scaling.idle_s} is no multiple of scaling.period_s = {s.scaling.period_s}",
            hint=f"make it a multiple {where}",
        )
    if not s.cloud.lab and not (s.cloud.certificate_arn and s.cloud.domain_name):
        raise SettingsError(
            "cloud.lab = false needs cloud.certificate_arn and cloud.domain_name",
            hint=f"set both {where}, or set cloud.lab to true",
        )


def did_you_mean(name: str, known: Mapping[str, Any]) -> str:
    """Return a hint: the known name that is close to *name*, else all of them."""
    close = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {close[0]}?" if close else f"known are {', '.join(known)}"
