"""Find the packages that `make assets` built, and lay the settings beside them.

Promises to build nothing itself: synthesis only hashes what it finds.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from rse_pf.errors import ConfigurationError
from rse_pf.settings import PlatformSettings

__all__ = ["SETTINGS_FILE", "staged"]

SETTINGS_FILE = "settings.json"


def staged(assets: Path, name: str, settings: PlatformSettings, into: Path) -> Path:
    """Return a copy of the folder *name* of *assets* below *into*, with the merged settings inside.

    The settings file has the form of cdk.json, so that `rse-pf --settings` reads it.

    Raises:
        ConfigurationError: The folder is missing, empty or cannot be read.
    """
    source = assets / name
    try:
        if not any(source.iterdir()):
            raise FileNotFoundError(f"{source} is empty")
        target = into / name
        shutil.copytree(source, target, dirs_exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"no packages in {source}", hint="run make assets") from error
    document = {"context": {"rse-pf": settings.to_dict()}}
    (target / SETTINGS_FILE).write_text(json.dumps(document, sort_keys=True) + "\n", encoding="utf-8")
    return target
