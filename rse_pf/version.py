"""The version of this software."""

from __future__ import annotations

from importlib import metadata

__all__ = ["installed_version"]


def installed_version() -> str:
    """Return the version of the installed distribution, "unknown" where rse-pf runs from a plain checkout."""
    try:
        return metadata.version("rse-pf")
    except metadata.PackageNotFoundError:
        return "unknown"
