"""Declare a setting, and check its value: its type, its range, and the form of texts.

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

# Largest absolute value of a number in the settings: whole numbers up to it are exact as float64.
_LARGEST = 1e15
# ``cloud.name``: empty, or at most 16 lower-case letters, digits and hyphens.
_DEPLOYMENT = re.compile(r"(?:[a-z](?:[a-z0-9-]{0,14}[a-z0-9])?)?")
# ``cloud.bootstrap_qualifier`` as the CDK accepts it.
_QUALIFIER = re.compile(r"[a-z0-9]{1,10}")
# The origin of a web page: scheme, host or IPv6 address, and perhaps a port.
_ORIGIN = re.compile(r"[a-z][a-z0-9+.-]*://(?:[a-z0-9._-]+|\[[0-9a-f:.]+\])(?::[0-9]{1,5})?", re.IGNORECASE)
# ``burst.url``: an HTTP address with a path, or a path alone.
_BURST_URL = re.compile(r"(?:https?://(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(?::[0-9]{1,5})?)?/[!-~]{0,200}")
# The length of the prefix at the end of a CIDR range.
_PREFIX = re.compile(r"/[0-9]{1,2}$")
# The name of an S3 bucket.
_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
# Where an operator changes a setting; part of the hints of errors.
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
    """Declare one setting as a dataclass field; the reference page, the CLI options and the checks use it.

    Args:
        default: The value if the operator sets none.
        doc: The meaning of the value, for the reference page and the help of the CLI.
        unit: The unit of the value, "" if it has none.
        source: Where the default comes from, such as a section of the paper; "ours" if this project chose it.
        low: The smallest allowed value; None for no bound.
        high: The largest allowed value; None for no bound.
        choices: The allowed values; empty if all values in the range are allowed.
    """
    metadata = {
        "doc": doc, "unit": unit, "source": source, "low": low, "high": high, "choices": choices,
    }  # fmt: skip
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, slots=True, kw_only=True)
class SettingRow:
    """One setting as a row of the reference page; the fields are those of `setting`, with the value."""

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
    """Return *value* if its type is *kind*; a whole number becomes a float if *kind* is float.

    Raises:
        SettingsError: *value* has another type, or is a number that is not finite or beyond ``1e15``.
    """
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
    """Raise SettingsError if the value of *row* is not one of its choices, or is out of its range."""
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
    """Raise SettingsError if *origin* has not the form of the header Origin: scheme, host, perhaps a port.

    *name* is the name of the setting.
    """
    if _ORIGIN.fullmatch(origin) is None:
        raise SettingsError(
            f"{name} has {_shown(origin)}, which is no origin of a web page",
            hint=f"write it as https://robots.example.org or http://localhost:9000 {WHERE}",
        )


def check_burst_url(name: str, url: str) -> None:
    """Raise SettingsError if *url*, the setting *name*, is neither empty, nor a path, nor an HTTP address."""
    if url and _BURST_URL.fullmatch(url) is None:
        raise SettingsError(
            f"{name} = {_shown(url)} is no place to send commands to",
            hint=f"use /burst, or an address such as https://robots.example.org/burst, {WHERE}",
        )


def check_cidr(name: str, cidr: str) -> None:
    """Raise SettingsError if *cidr*, the setting *name*, is not an IPv4 range such as ``192.0.2.0/24``."""
    try:
        if _PREFIX.search(cidr) is None:
            raise ValueError
        ipaddress.IPv4Network(cidr, strict=False)  # AWS accepts bits after the prefix, and clears them
    except ValueError:
        raise SettingsError(
            f"{name} = {_shown(cidr)} is no range of IPv4 addresses",
            hint=f"write it as 192.0.2.0/24, with a prefix of 0 to 32 bits, {WHERE}",
        ) from None


def check_buckets(name: str, buckets: str) -> None:
    """Raise SettingsError if *buckets*, separated by spaces, holds a name that no S3 bucket can have."""
    for bucket in buckets.split():
        if _BUCKET.fullmatch(bucket) is None:
            raise SettingsError(
                f"{name} has {_shown(bucket)}, which is no name of a bucket",
                hint=f"write names such as rsepf-data-maps-1a2b3c, without s3:// and paths, {WHERE}",
            )


def check_deployment(name: str, qualifier: str) -> None:
    """Raise SettingsError if AWS would refuse resource names that hold *name* or *qualifier*.

    Args:
        name: The setting ``cloud.name``.
        qualifier: The setting ``cloud.bootstrap_qualifier``.
    """
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
    """Return a hint for the unknown *name*: the name in *known* that is most similar to it.

    If none is similar, the hint is *otherwise* or, if that is empty, the list of all names in *known*.
    """
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    return f"did you mean {close[0]}?" if close else otherwise or f"known are {', '.join(known)}"
