"""Read settings from a file."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from rse_pf.config.settings import PlatformSettings
from rse_pf.errors import SettingsError

__all__ = ["load_settings"]


def load_settings(path: Path | None = None) -> PlatformSettings:
    """Return the built-in defaults with the overrides in ``context."rse-pf"`` of the JSON file *path*.

    Without *path* the file is ``./cdk.json``; if that file does not exist, the defaults are returned.

    Raises:
        SettingsError: The file cannot be read or is not JSON, or it holds a setting that is unknown, invalid
            or outside of ``context."rse-pf"``.
    """
    chosen = path or Path("cdk.json")
    if path is None and not chosen.exists():
        return PlatformSettings()
    try:
        document = json.loads(chosen.read_text(encoding="utf-8"))
    except OSError as error:
        raise SettingsError(
            f"cannot read {chosen}: {error.strerror}", hint="name an existing file with --settings"
        ) from error
    except (ValueError, RecursionError) as error:
        raise SettingsError(f"{chosen} is not JSON: {error}", hint="correct the file") from error
    context = document.get("context", {}) if isinstance(document, dict) else None
    overrides = context.get("rse-pf", {}) if isinstance(context, dict) else None
    if not isinstance(overrides, dict):
        raise SettingsError(
            f'{chosen} has no object at context."rse-pf"',
            hint='write {"context": {"rse-pf": {"scaling": {"max_servers": 4}}}}',
        )
    groups = {group.name for group in dataclasses.fields(PlatformSettings)}
    misplaced = sorted(groups.intersection(document)) if not overrides else []
    if misplaced:
        raise SettingsError(
            f"{chosen} has {', '.join(misplaced)} at its top, where settings are not read",
            hint='write {"context": {"rse-pf": {"scaling": {"max_servers": 4}}}}',
        )
    return PlatformSettings.from_dict(overrides)
