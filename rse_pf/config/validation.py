"""What a setting consists of, and why its value may be refused: unknown, of the wrong type, out of range.

Every error names the setting, the value and its limit, and says what to do.
"""

from __future__ import annotations

import difflib
import ipaddress
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from rse_pf.errors import SettingsError

__all__ = [
    "WHERE",
    "SettingRow",
    "check_buckets",
    "check_burst_url",
    "check_cidr",
    "check_deployment",
    "check_origin",
    "check_range",
    "did_you_mean",
    "setting",
    "typed",
]

_LARGEST = 1e15
_DEPLOYMENT = re.compile(r"(?:[a-z](?:[a-z0-9-]{0,14}[a-z0-9])?)?")
_QUALIFIER = re.compile(r"[a-z0-9]{1,10}")
_ORIGIN = re.compile(r"[a-z][a-z0-9+.-]*://(?:[a-z0-9._-]+|\[[0-9a-f:.]+\])(?::[0-9]{1,5})?", re.IGNORECASE)
_BURST_URL = re.compile(r"(?:https?://(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(?::[0-9]{1,5})?)?/[!-~]{0,200}")
_PREFIX = re.compile(r"/[0-9]{1,2}$")
_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
WHERE = 'in cdk.json, context."rse-pf"'


def setting(
    default: Any,
    *,
    doc: str,
    unit: str = "",
    source: str = "ours",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
) -> Any:
    """Declare one setting; the docs table, the CLI and the checks all come from here."""
    metadata = {
        "doc": doc, "unit": unit, "source": source, "low": low, "high": high, "choices": choices,
    }  # fmt: skip
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingRow:
    """One setting as a row of the documentation."""

    group: str
    name: str
    value: Any
    default: Any
    unit: str
    source: str
    doc: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]


def typed(name: str, value: Any, kind: Any) -> Any:
    """Return *value* as *kind*, a whole number as a float where one is meant; raises SettingsError."""
    if kind in (int, float) and type(value) in (int, float) and not abs(value) <= _LARGEST:
        raise SettingsError(f"{name} is not a finite number below {_LARGEST:g}", hint=f"correct it {WHERE}")
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise SettingsError(
            f"{name} = {_shown(value)} is not of type {kind.__name__}", hint=f"correct it {WHERE}"
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
    if row.choices and row.value not in row.choices:
        raise SettingsError(
            f"{row.group}.{row.name} = {row.value!r} is not one of {', '.join(row.choices)}",
            hint=f"choose one of them {WHERE}",
        )
    if row.low is not None and not row.value >= row.low:
        raise SettingsError(
            f"{row.group}.{row.name} = {row.value} is below {row.low:g}", hint=f"raise it {WHERE}"
        )
    if row.high is not None and not row.value <= row.high:
        raise SettingsError(
            f"{row.group}.{row.name} = {row.value} is above {row.high:g}", hint=f"lower it {WHERE}"
        )


def check_origin(name: str, origin: str) -> None:
    """Raise SettingsError if *origin* is not one that a browser sends: a scheme, a host, perhaps a port."""
    if _ORIGIN.fullmatch(origin) is None:
        raise SettingsError(
            f"{name} has {_shown(origin)}, which is no origin of a web page",
            hint=f"write it as https://robots.example.org or http://localhost:9000 {WHERE}",
        )


def check_burst_url(name: str, url: str) -> None:
    """Raise SettingsError if *url* is neither empty, nor a path, nor an address of HTTP."""
    if url and _BURST_URL.fullmatch(url) is None:
        raise SettingsError(
            f"{name} = {_shown(url)} is no place to send commands to",
            hint=f"use /burst, or an address such as https://robots.example.org/burst, {WHERE}",
        )


def check_cidr(name: str, cidr: str) -> None:
    """Raise SettingsError if *cidr* is not a range of IPv4 addresses with the length of its prefix."""
    try:
        if _PREFIX.search(cidr) is None:
            raise ValueError
        ipaddress.IPv4Network(cidr, strict=False)  # AWS clears the bits behind the prefix
    except ValueError:
        raise SettingsError(
            f"{name} = {_shown(cidr)} is no range of IPv4 addresses",
            hint=f"write it as 192.0.2.0/24, with a prefix of 0 to 32 bits, {WHERE}",
        ) from None


def check_buckets(name: str, buckets: str) -> None:
    """Raise SettingsError if *buckets*, with spaces between, holds a name that no bucket of S3 has."""
    for bucket in buckets.split():
        if _BUCKET.fullmatch(bucket) is None:
            raise SettingsError(
                f"{name} has {_shown(bucket)}, which is no name of a bucket",
                hint=f"write names such as rsepf-data-maps-1a2b3c, without s3:// and paths, {WHERE}",
            )


def check_deployment(name: str, qualifier: str) -> None:
    """Raise SettingsError if AWS would not take ``cloud.name`` or ``cloud.bootstrap_qualifier`` in a name."""
    if _DEPLOYMENT.fullmatch(name) is None:
        raise SettingsError(
            f"cloud.name = {_shown(name)} is no name of a deployment",
            hint=f"use at most 16 small letters, digits and hyphens, such as lab or team-2, {WHERE}",
        )
    if _QUALIFIER.fullmatch(qualifier) is None:
        raise SettingsError(
            f"cloud.bootstrap_qualifier = {_shown(qualifier)} is no qualifier of the CDK",
            hint=f"use 1 to 10 small letters and digits, as at npx cdk bootstrap --qualifier, {WHERE}",
        )


def did_you_mean(name: str, known: Iterable[str], otherwise: str = "") -> str:
    """Return a hint: the known name that is close to *name*, else *otherwise* or all of them."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {close[0]}?" if close else otherwise or f"known are {', '.join(known)}"
