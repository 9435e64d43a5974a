"""Read settings from a file."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

from rse_pf.config.settings import PlatformSettings
from rse_pf.errors import SettingsError

__all__ = ["load_settings"]


def load_settings(path: Path | None = None) -> PlatformSettings:
    """Read ``context."rse-pf"`` of *path*, by default ``./cdk.json``, else the built-in defaults.

    Raises:
        SettingsError: The file is named but missing, is not JSON, or holds a bad or misplaced setting.
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
