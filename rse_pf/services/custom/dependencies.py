"""The Python packages of a service: lock their versions and hashes, install wheels, and verify them.

An author writes the wanted packages to ``requirements.in``; `lock_dependencies` resolves them to
``requirements.txt``, the lock, with one version and its hashes for each package; `build_dependencies`
installs the lock.  Only wheels are installed, so that no code of a package runs outside of a sandbox.  A line
that an author wrote is parsed, and a line that names a folder or an address is refused, before pip gets the
lines: pip would execute the build code of that folder, or download from that address.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from rse_pf.errors import CommandFailed, ConfigurationError, MissingExtra, UsageError
from rse_pf.services.custom.regular_files import read_regular_file
from rse_pf.storage.files import replace_file, replace_json

__all__ = [
    "LOCK_FILE",
    "SHA256_PATTERN",
    "Dependencies",
    "LockedRequirement",
    "build_dependencies",
    "copy_dependencies",
    "lock_dependencies",
    "platform_tag",
    "read_lock",
    "require_same_versions",
    "tree_digest",
    "verify_dependencies",
    "write_lock",
]

LOCK_FILE = "requirements.txt"
"""Name of the lock in the folder of a service."""
_WANTED_FILE = "requirements.in"
"""Name of the file in the folder of a service that lists the wanted packages."""
PROVIDED = ("msgspec", "numpy")
"""Packages that every sandbox has loaded before it loads the service.  A lock must not name them, because the
service would not get the version of the lock."""

_LOCKED_LINE = re.compile(
    r"(?P<name>[A-Za-z0-9](?:[\w.-]*[A-Za-z0-9])?)(?:\[[\w.,\s-]*\])?\s*==\s*(?P<version>[\w.!+-]+)"
    r"(?P<marker>\s*;(?:(?!\s-)[^#$])*?)?(?P<hashes>(?:\s+--hash=sha256:[0-9a-f]{64})+)"
)
"""A line of a lock: name, extras, one version, environment marker, and at least one SHA-256."""
_LINE_WITHOUT_HASH = re.compile(r"[\w.\[\],-]+\s*==\s*[\w.!+-]+\s*(;.*)?")
"""A line with one version but no hash, for a helpful error."""
SHA256_PATTERN = re.compile(r"[0-9a-f]{64}")
"""A SHA-256 in hexadecimal digits."""
_REMOVED_VARIABLES = {
    "PIP_NO_BINARY",
    "PIP_ONLY_BINARY",
    "PIP_TARGET",
    "PIP_PREFIX",
    "PIP_USER",
    "PIP_REQUIRE_HASHES",
}
"""Environment variables that pip does not get, since they would change which files are installed, or
where."""
_MAX_REASON = 300
"""Largest number of characters of pip's reason that an error quotes; the rest is cut off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LockedRequirement:
    """A package of a lock: its normalised name, its version, and its line for pip with the hashes."""

    name: str
    version: str
    line: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Dependencies:
    """The installed packages of a service.

    Attributes:
        folder: Folder of the packages; the last part of its path is *digest*.
        digest: `tree_digest` of *folder*.
        packages: Versions of the packages by name.
        platform: `platform_tag` of the interpreter for which they were installed.
    """

    folder: Path
    digest: str
    packages: Mapping[str, str]
    platform: str


def platform_tag() -> str:
    """Return interpreter and machine of this process, which wheels must fit, as ``cp311-linux-x86_64``."""
    return f"cp{sys.version_info.major}{sys.version_info.minor}-{sysconfig.get_platform()}"


def read_lock(folder: Path) -> list[LockedRequirement]:
    """Return the packages of the lock in *folder*, sorted by name; an empty list without a lock.

    Raises:
        UsageError: The lock cannot be read, or a line is not one version of a package with hashes, or names a
            package that an earlier line names or that every sandbox provides.
    """
    path = folder / LOCK_FILE
    text = _read_text(path)
    if text is None:
        return []
    hint = f"lock the versions: rse-pf service lock {folder}"
    requirements: dict[str, LockedRequirement] = {}
    for number, line in _numbered_lines(text):
        match = _LOCKED_LINE.fullmatch(line)
        where = f"{path}, line {number}"
        if match is None:
            raise UsageError(f"{where}: {line[:80]!r} {_why_unlocked(line)}", hint=hint)
        name = _normalised(match["name"])
        if name in PROVIDED:
            raise UsageError(
                f"{where}: every sandbox has {name} {metadata.version(name)} already",
                hint=f"leave it out, or {hint}",
            )
        if name in requirements:
            raise UsageError(f"{where}: {name} is locked twice", hint=hint)
        requirements[name] = LockedRequirement(
            name=name, version=match["version"], line=" ".join(line.split())
        )
    return sorted(requirements.values(), key=lambda requirement: requirement.name)


def build_dependencies(folder: Path, store: Path) -> Dependencies | None:
    """Install the packages that the service in *folder* locks; return None if it locks none.

    A file below *store*, named by the SHA-256 of the platform tag and the lines of the lock, records the
    result.  If this file exists and the packages that it describes are unchanged, they are returned without a
    call of pip.

    Args:
        folder: The service.
        store: Folder below which the packages of each lock are installed in a folder of their own, which is
            named by its `tree_digest`.

    Raises:
        UsageError: The lock is invalid, or pip is not installed.
        CommandFailed: pip fails: a package has no wheel for this platform, or a hash differs.
    """
    requirements = read_lock(folder)
    if not requirements:
        return None
    lines = [requirement.line for requirement in requirements]
    key = hashlib.sha256("\n".join([platform_tag(), *lines]).encode()).hexdigest()
    record = store / f"{key}.json"
    dependencies = _find_built(record, store)
    if dependencies is None:
        dependencies = _install(requirements, folder, store)
        replace_json(record, asdict(dependencies) | {"folder": None})
    return dependencies


def verify_dependencies(dependencies: Dependencies, service: str) -> None:
    """Check that the packages of *service* are for this interpreter and machine, and unchanged.

    Raises:
        ConfigurationError: The packages are for another platform, missing, or a file was changed, added or
            removed.
    """
    hint = "install the service again with: rse-pf service install FOLDER"
    folder = dependencies.folder
    if dependencies.platform != platform_tag():
        raise ConfigurationError(
            f"the packages of {service} are for {dependencies.platform}, this server is {platform_tag()}",
            hint=hint,
        )
    if not folder.is_dir():
        raise ConfigurationError(f"the packages of {service} are missing: {folder}", hint=hint)
    if tree_digest(folder) != dependencies.digest:
        raise ConfigurationError(f"the packages of {service} were changed: {folder}", hint=hint)


def require_same_versions(packages: Mapping[str, Mapping[str, str]]) -> None:
    """Check that services need the same version of each package, since one sandbox may load all services.

    Args:
        packages: For each service the versions of its packages by name.

    Raises:
        ConfigurationError: Two services need different versions of a package.
    """
    first_users: dict[str, tuple[str, str]] = {}
    for service, versions in sorted(packages.items()):
        for package, version in versions.items():
            first_service, first_version = first_users.setdefault(package, (service, version))
            if first_version != version:
                raise ConfigurationError(
                    f"{first_service} needs {package} {first_version} and {service} needs {package} "
                    f"{version}, and the sandbox of a robot may run both",
                    hint="lock both services to one version, or serve them by different servers",
                )


def copy_dependencies(dependencies: Dependencies, store: Path) -> None:
    """Copy packages to the folder below *store* that is named by their digest.

    A folder of this name stays if its content has the digest, and is replaced otherwise.  The content of the
    new copy is not compared with the digest; a caller that needs this calls `verify_dependencies`.
    """
    target = store / dependencies.digest
    if target.is_dir() and tree_digest(target) == dependencies.digest:
        return
    store.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=".new-", dir=store))
    shutil.copytree(dependencies.folder, fresh, dirs_exist_ok=True, symlinks=True)
    _publish_folder(fresh, target)


def tree_digest(folder: Path) -> str:
    """Return the SHA-256 of paths and contents of all files below *folder*.

    Modes of files and empty folders do not count.  The content of a symbolic link is the path to which it
    points; the link is not followed.
    """
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_dir() and not path.is_symlink():
            continue
        content = os.readlink(path).encode() if path.is_symlink() else path.read_bytes()
        name = path.relative_to(folder).as_posix()
        digest.update(f"{name}\0{hashlib.sha256(content).hexdigest()}\n".encode())
    return digest.hexdigest()


def lock_dependencies(folder: Path) -> list[LockedRequirement]:
    """Resolve ``requirements.in`` in *folder* with pip, write ``requirements.txt``, and return its packages.

    Without ``requirements.in``, the wanted packages are the lines of ``requirements.txt``.  After pip has
    resolved them, the former text of ``requirements.txt`` is saved as ``requirements.in``, and the lock
    replaces ``requirements.txt``.  Only wheels for this interpreter and machine are chosen.
    Packages that every sandbox provides are left out of the lock.  The lock stays as it is if an error is
    raised.

    Raises:
        UsageError: There is neither file, it cannot be read, a line is more than a name with extras,
            versions, marker and hashes, or pip is not installed.
        CommandFailed: pip finds no versions that fit together, or no wheel.
        MissingExtra: The package ``packaging``, which parses the lines, is not installed.
    """
    # 1. Read and validate the wanted packages.
    wanted, lock = folder / _WANTED_FILE, folder / LOCK_FILE
    source, text = wanted, _read_text(wanted)
    if text is None:
        source, text = lock, _read_text(lock)
    if text is None:
        raise UsageError(
            f"there is no {wanted}",
            hint="write the packages that the service imports there, one on each line",
        )
    lines = [_validate_wanted(line, f"{source}, line {number}") for number, line in _numbered_lines(text)]
    # 2. Let pip resolve them, with the provided packages fixed to their installed versions.
    with tempfile.TemporaryDirectory(prefix="rse-pf-lock-") as temporary:
        report, constraints = Path(temporary, "report.json"), Path(temporary, "constraints.txt")
        requirements = Path(temporary, "requirements.txt")
        requirements.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
        provided = "".join(f"{name}=={metadata.version(name)}\n" for name in PROVIDED)
        constraints.write_text(provided, encoding="utf-8")
        options = ["--dry-run", "--ignore-installed", "--report", str(report)]
        _run_pip(
            *options,
            "-c",
            str(constraints),
            "-r",
            str(requirements),
            hint=f"correct {source}; a package must have a wheel for {platform_tag()}",
        )
        document = json.loads(report.read_text(encoding="utf-8"))
    # 3. Write ``requirements.in`` if it did not exist, and the lock.
    if source == lock:
        replace_file(wanted, text.encode())
    resolved = filter(None, map(_read_report_entry, document["install"]))
    locked = sorted(resolved, key=lambda requirement: requirement.name)
    write_lock(lock, locked, f"Locked from {_WANTED_FILE} by rse-pf service lock, for {platform_tag()}.")
    return locked


def write_lock(path: Path, requirements: Sequence[LockedRequirement], comment: str) -> None:
    """Replace the lock *path* by the lines of *requirements* after a line with *comment*."""
    lines = (f"# {comment}", *(requirement.line for requirement in requirements))
    replace_file(path, "".join(f"{line}\n" for line in lines))


def _install(requirements: Sequence[LockedRequirement], folder: Path, store: Path) -> Dependencies:
    store.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=".new-", dir=store))
    lock = fresh.with_suffix(".lock")
    try:
        write_lock(lock, requirements, "one installation")
        _run_pip(
            "--require-hashes",
            "--no-deps",
            "--no-compile",
            "--target",
            str(fresh.absolute()),
            "-r",
            str(lock.absolute()),
            hint=f"only wheels with the hashes of the lock are installed: rse-pf service lock {folder}",
        )
        shutil.rmtree(fresh / "bin", ignore_errors=True)  # Scripts, since sandboxes cannot start programs.
        digest = tree_digest(fresh)
        _publish_folder(fresh, store / digest)
    finally:
        lock.unlink(missing_ok=True)
        shutil.rmtree(fresh, ignore_errors=True)
    packages = {requirement.name: requirement.version for requirement in requirements}
    return Dependencies(folder=store / digest, digest=digest, packages=packages, platform=platform_tag())


def _publish_folder(fresh: Path, target: Path) -> None:
    """Make *fresh* readable for all users and its files read-only, then rename it to *target*.

    A folder *target* is removed first.
    """
    for path in (fresh, *fresh.rglob("*")):
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() else 0o444)
    shutil.rmtree(target, ignore_errors=True)
    fresh.rename(target)


def _find_built(record: Path, store: Path) -> Dependencies | None:
    """Return the packages below *store* that the file *record* describes.

    The result is None if the record is missing or damaged, or the packages are missing or changed.
    """
    try:
        document = json.loads(record.read_text(encoding="utf-8"))
        built = Dependencies(**{**document, "folder": store / document["digest"]})
    except (OSError, ValueError, KeyError, TypeError):
        return None
    is_present = SHA256_PATTERN.fullmatch(built.digest) and built.folder.is_dir()
    return built if is_present and tree_digest(built.folder) == built.digest else None


def _read_text(path: Path) -> str | None:
    """Return the text of the file *path*, None if there is no such file.

    Raises:
        UsageError: The file is not a regular file, cannot be read, or is not UTF-8.
    """
    try:
        return read_regular_file(path).decode("utf-8")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read {path}: {error}", hint="write one package on each line") from error


def _validate_wanted(line: str, where: str) -> str:
    """Return the line of a wanted package as pip gets it: a name, extras, versions, a marker, and hashes.

    Raises:
        UsageError: The line is anything else; the error names the place *where*.
        MissingExtra: The package ``packaging`` is not installed.
    """
    try:
        from packaging.requirements import InvalidRequirement, Requirement
    except ImportError as error:
        raise MissingExtra("packaging", "backend") from error
    locked = _LOCKED_LINE.fullmatch(line)
    hashes = "" if locked is None else locked["hashes"]
    try:
        parsed = Requirement(line.removesuffix(hashes))
    except InvalidRequirement:
        parsed = None
    if parsed is None or parsed.url is not None or "$" in line:
        raise UsageError(
            f"{where}: {line[:80]!r} is not the name of a package with its versions",
            hint="write lines such as scipy>=1.11: no path, no address, no option of pip, no variable",
        )
    parsed.name = _normalised(parsed.name)  # pip would read a name such as a.zip as a file.
    return f"{parsed}{hashes}"


def _run_pip(*arguments: str, hint: str) -> None:
    """Run ``pip install`` with *arguments*, for wheels only.

    Raises:
        CommandFailed: pip fails; the error quotes its first reason, with *hint*.
        UsageError: pip is not installed.
    """
    options = ["--only-binary=:all:", "--quiet", "--no-input", "--disable-pip-version-check"]
    command = [sys.executable, "-m", "pip", "install", *options, *arguments]
    variables = {name: value for name, value in os.environ.items() if name not in _REMOVED_VARIABLES}
    # An empty folder, since python -m imports modules from the current folder.
    with tempfile.TemporaryDirectory(prefix="rse-pf-pip-") as empty:
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=variables, cwd=empty)
    if done.returncode == 0:
        return
    if "No module named pip" in done.stderr:
        raise UsageError("pip is not installed", hint=f"{sys.executable} -m ensurepip")
    reasons = [line for line in done.stderr.splitlines() if line.startswith("ERROR: ")]
    reason = (reasons or done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[0]
    raise CommandFailed(f"pip: {reason.removeprefix('ERROR: ')[:_MAX_REASON]}", hint=hint)


def _read_report_entry(entry: Mapping[str, Any]) -> LockedRequirement | None:
    """Return the package of an entry of pip's report; None if every sandbox provides the package.

    Raises:
        CommandFailed: The entry has no SHA-256, since it is not a file of an index.
    """
    name, version = _normalised(entry["metadata"]["name"]), entry["metadata"]["version"]
    if name in PROVIDED:
        return None
    sha256 = entry["download_info"].get("archive_info", {}).get("hashes", {}).get("sha256", "")
    if not SHA256_PATTERN.fullmatch(sha256):
        raise CommandFailed(
            f"pip found {name} {version} at a place that states no SHA-256 of a file",
            hint="name a version of which a package index has a wheel",
        )
    return LockedRequirement(name=name, version=version, line=f"{name}=={version} --hash=sha256:{sha256}")


def _numbered_lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield number and text of each line that is not empty without its comment.

    A backslash at the end of a line continues it; both lines are one, with the number of the first.
    """
    number, continued = 0, ""
    for line_number, raw in enumerate(text.splitlines(), 1):
        number = number if continued else line_number
        line = f"{continued} {re.sub(r'(^|[ ])#.*', '', raw).strip()}".strip()
        if line.endswith("\\"):
            continued = line[:-1].rstrip() or " "
            continue
        continued = ""
        if line:
            yield number, line
    if continued.strip():
        yield number, continued.strip()


def _why_unlocked(line: str) -> str:
    if line.startswith("-"):
        return "is an option of pip, which a lock does not take"
    if "@" in line or "://" in line or line.startswith((".", "/")):
        return "is an address, not a version of an index"
    return (
        "has no sha256 hash"
        if _LINE_WITHOUT_HASH.match(line)
        else "is not locked to one version and its hashes"
    )


def _normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
