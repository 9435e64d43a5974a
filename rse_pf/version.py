"""The version of this software."""

from __future__ import annotations

from importlib import metadata

__all__ = ["installed_version"]


def installed_version() -> str:
    """Return the version of the installed distribution ``rse-pf``; "unknown" if none is installed."""
    try:
        return metadata.version("rse-pf")
    except metadata.PackageNotFoundError:
        return "unknown"
