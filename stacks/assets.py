"""Copy the packages that `make assets` built, and add the settings and the boot files.

Nothing is built here: the synthesis only copies and hashes the packages.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

from rse_pf.config import PlatformSettings
from rse_pf.config.server_settings import server_settings
from rse_pf.errors import ConfigurationError

__all__ = ["ENVIRONMENT_FILE", "SERVERS", "SETTINGS_FILE", "SUMS_FILE", "staged", "sums_digest", "sums_text"]

SETTINGS_FILE = "settings.json"
SUMS_FILE = "SHA256SUMS"
SERVERS = "servers"
"""Name of the package of the backend servers: the folder of the archives that a server unpacks."""
ENVIRONMENT_FILE = "environment.json"
"""File in the package `SERVERS` with the Python version of the archives, and the digests of our sources."""
_BOOT = Path(__file__).parent / "boot"
_USER_DATA_SCRIPT = "first_boot.py"  # not in the package, because the launch template holds it as user data
_ROOT = Path(__file__).resolve().parents[1]
_PACKAGE = "rse_pf"


def staged(assets: Path, name: str, settings: PlatformSettings, into: Path) -> Path:
    """Copy the package *name* from the folder *assets* into the folder *into*, and add the merged settings.

    Return the folder of the copy.  The settings file has the form of cdk.json, so that `rse-pf --settings`
    reads it.  The package of the servers also gets the boot files, and the list of all sha256 sums that
    `first_boot.py` checks.  It holds only those settings that a server reads, so that a change of another
    setting does not replace servers.

    Raises:
        ConfigurationError: The package is missing, empty, cannot be read, or was built of other sources than
            those of this checkout.
    """
    source, target = assets / name, into / name
    chosen = server_settings(settings) if name == SERVERS else settings.to_dict()
    document = {"context": {"rse-pf": chosen}}
    try:
        if not any(source.iterdir()):
            raise FileNotFoundError(f"{source} is empty")
        shutil.copytree(source, target, dirs_exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"no packages in {source}", hint="run make assets") from error
    _check_fresh(source)
    (target / SETTINGS_FILE).write_text(json.dumps(document, sort_keys=True) + "\n", encoding="utf-8")
    if name == SERVERS:
        for file in sorted(_BOOT.iterdir()):
            if file.is_file() and file.name != _USER_DATA_SCRIPT:
                shutil.copyfile(file, target / file.name)
        (target / SUMS_FILE).write_text(sums_text(target), encoding="utf-8")
    return target


def sums_digest(package: Path) -> str:
    """Return the sha256 of the list of sums in *package*; the list covers every byte of the package."""
    return hashlib.sha256((package / SUMS_FILE).read_bytes()).hexdigest()


def _check_fresh(packages: Path) -> None:
    """Raise ConfigurationError if *packages* was built of other sources than those of this checkout.

    Other sources might not know the settings that are added.
    """
    built = {
        file.relative_to(packages).as_posix(): _digest(file) for file in (packages / _PACKAGE).rglob("*.py")
    }
    built.update(_read_digests(packages / ENVIRONMENT_FILE))
    if not built:
        return
    sources = {file.relative_to(_ROOT).as_posix(): file for file in (_ROOT / _PACKAGE).rglob("*.py")}
    if built.keys() != sources.keys() or any(_digest(sources[name]) != built[name] for name in built):
        raise ConfigurationError(
            f"the packages in {packages} were built of other sources", hint="run make assets"
        )


def _read_digests(file: Path) -> dict[str, str]:
    """Return the digests of our sources by path, which the build wrote into *file*; none without the file."""
    if not file.exists():
        return {}
    try:
        listed: dict[str, str] = dict(json.loads(file.read_text(encoding="utf-8"))["sources"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigurationError(f"{file} cannot be read: {error}", hint="run make assets") from error
    return listed


def _digest(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def sums_text(folder: Path) -> str:
    """Return a line with digest and path for each file in *folder*, as ``sha256sum`` writes them.

    The list itself, `SUMS_FILE`, is left out.
    """
    files = sorted(file for file in folder.rglob("*") if file.is_file() and file.name != SUMS_FILE)
    return "".join(
        f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.relative_to(folder).as_posix()}\n"
        for file in files
    )
