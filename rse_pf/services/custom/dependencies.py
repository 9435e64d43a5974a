"""Python packages of a service's own: locked by hashes, installed once from wheels, named by their content.

``requirements.txt`` in the folder of a service names every package with its version and hashes.  Only wheels
are installed, so that no code of a package runs before it is inside the sandbox.  What an author wishes for
is parsed here, and pip gets names and versions alone: it would build a folder, and follow an address.
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
from rse_pf.files import replace_file, replace_json
from rse_pf.services.custom.plain_files import read_plain

__all__ = [
    "LOCK_FILE",
    "Dependencies",
    "LockedRequirement",
    "build_dependencies",
    "check_dependencies",
    "check_together",
    "copy_dependencies",
    "lock_dependencies",
    "platform_tag",
    "read_lock",
    "tree_digest",
    "write_lock",
]

LOCK_FILE = "requirements.txt"
_WANTED_FILE = "requirements.in"
PROVIDED = ("msgspec", "numpy")
"""Packages that a sandbox has loaded before a service is: another version would not be used."""

_LINE = re.compile(
    r"(?P<name>[A-Za-z0-9](?:[\w.-]*[A-Za-z0-9])?)(?:\[[\w.,\s-]*\])?\s*==\s*(?P<version>[\w.!+-]+)"
    r"(?P<marker>\s*;(?:(?!\s-)[^#$])*?)?(?P<hashes>(?:\s+--hash=sha256:[0-9a-f]{64})+)"
)
_PINNED = re.compile(r"[\w.\[\],-]+\s*==\s*[\w.!+-]+\s*(;.*)?")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_LEFT_OUT_VARIABLES = {
    "PIP_NO_BINARY",
    "PIP_ONLY_BINARY",
    "PIP_TARGET",
    "PIP_PREFIX",
    "PIP_USER",
    "PIP_REQUIRE_HASHES",
}
"""Settings of pip that would change what is installed where."""
_MAX_REASON = 300


@dataclass(frozen=True, slots=True, kw_only=True)
class LockedRequirement:
    """One package of a lock: its normalised name, its version, and its line for pip."""

    name: str
    version: str
    line: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Dependencies:
    """Installed packages.

    ``folder`` is named by ``digest``, which `tree_digest` gives; ``packages`` maps names to versions, and
    ``platform`` is the `platform_tag` that they were installed for.
    """

    folder: Path
    digest: str
    packages: Mapping[str, str]
    platform: str


def platform_tag() -> str:
    """Return the interpreter and machine that wheels are chosen for, such as ``cp311-linux-x86_64``."""
    return f"cp{sys.version_info.major}{sys.version_info.minor}-{sysconfig.get_platform()}"


def read_lock(folder: Path) -> list[LockedRequirement]:
    """Return what ``requirements.txt`` in *folder* locks, sorted by name; nothing if there is no such file.

    Raises:
        UsageError: A line is not one version with hashes, or names a package that every sandbox provides.
    """
    path = folder / LOCK_FILE
    text = _text_of(path)
    if text is None:
        return []
    hint = f"lock the versions: rse-pf service lock {folder}"
    found: dict[str, LockedRequirement] = {}
    for number, line in _lines(text):
        match = _LINE.fullmatch(line)
        where = f"{path}, line {number}"
        if match is None:
            raise UsageError(f"{where}: {line[:80]!r} {_why_unlocked(line)}", hint=hint)
        name = _normalised(match["name"])
        if name in PROVIDED:
            raise UsageError(
                f"{where}: every sandbox has {name} {metadata.version(name)} already",
                hint=f"leave it out, or {hint}",
            )
        if name in found:
            raise UsageError(f"{where}: {name} is locked twice", hint=hint)
        found[name] = LockedRequirement(name=name, version=match["version"], line=" ".join(line.split()))
    return sorted(found.values(), key=lambda each: each.name)


def build_dependencies(folder: Path, store: Path) -> Dependencies | None:
    """Return the installed packages of the service in *folder*, None if it locks none.

    They are installed below *store* once; later calls with the same lock find them there.

    Raises:
        UsageError: The lock is refused, or pip is not installed.
        CommandFailed: pip cannot install it: there is no wheel, or a hash differs.
    """
    requirements = read_lock(folder)
    if not requirements:
        return None
    lines = [each.line for each in requirements]
    key = hashlib.sha256("\n".join([platform_tag(), *lines]).encode()).hexdigest()
    record = store / f"{key}.json"
    built = _built(record, store)
    if built is None:
        built = _install(requirements, folder, store)
        document = asdict(built) | {"folder": None}
        replace_json(record, document)
    return built


def check_dependencies(built: Dependencies, service: str) -> None:
    """Check that the packages of *service* are for this interpreter, and that no byte was changed.

    Raises:
        ConfigurationError: They are not, or something was changed, added or removed.
    """
    hint = "install the service again with: rse-pf service install FOLDER"
    if built.platform != platform_tag():
        raise ConfigurationError(
            f"the packages of {service} are for {built.platform}, this server is {platform_tag()}", hint=hint
        )
    if not built.folder.is_dir():
        raise ConfigurationError(f"the packages of {service} are missing: {built.folder}", hint=hint)
    if tree_digest(built.folder) != built.digest:
        raise ConfigurationError(f"the packages of {service} were changed: {built.folder}", hint=hint)


def check_together(built: Mapping[str, Dependencies]) -> None:
    """Check that services (name to packages) agree on versions: one sandbox may load all of them.

    Raises:
        ConfigurationError: Two services lock different versions of one package.
    """
    owners: dict[str, tuple[str, str]] = {}
    for service, each in sorted(built.items()):
        for package, version in each.packages.items():
            owner, other = owners.setdefault(package, (service, version))
            if other != version:
                raise ConfigurationError(
                    f"{owner} needs {package} {other} and {service} needs {package} {version}, "
                    "and the sandbox of a robot may run both",
                    hint="lock both services to one version, or serve them by different servers",
                )


def copy_dependencies(built: Dependencies, store: Path) -> None:
    """Copy *built* below *store*, under its digest; what is there already and unchanged is kept."""
    target = store / built.digest
    if target.is_dir() and tree_digest(target) == built.digest:
        return
    store.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=".new-", dir=store))
    shutil.copytree(built.folder, fresh, dirs_exist_ok=True, symlinks=True)
    _settle(fresh, target)


def tree_digest(folder: Path) -> str:
    """Return the SHA-256 of the names and contents of all files below *folder*; a link is its own content."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.is_dir() and not path.is_symlink():
            continue
        content = os.readlink(path).encode() if path.is_symlink() else path.read_bytes()
        name = path.relative_to(folder).as_posix()
        digest.update(f"{name}\0{hashlib.sha256(content).hexdigest()}\n".encode())
    return digest.hexdigest()


def lock_dependencies(folder: Path) -> list[LockedRequirement]:
    """Resolve ``requirements.in`` in *folder* and write the lock; return what it holds.

    Without that file, ``requirements.txt`` is taken for it and kept under its name.  Only wheels for this
    interpreter are chosen.

    Raises:
        UsageError: There is neither file, a line is more than a name with versions, or pip is not installed.
        CommandFailed: pip finds no versions that fit, or no wheel.
        MissingExtra: The package that parses the lines is not installed.
    """
    wanted, lock = folder / _WANTED_FILE, folder / LOCK_FILE
    source, text = wanted, _text_of(wanted)
    if text is None:
        source, text = lock, _text_of(lock)
    if text is None:
        raise UsageError(
            f"there is no {wanted}",
            hint="write the packages that the service imports there, one on each line",
        )
    lines = [_wish(line, f"{source}, line {number}") for number, line in _lines(text)]
    with tempfile.TemporaryDirectory(prefix="rse-pf-lock-") as temporary:
        report, constraints = Path(temporary, "report.json"), Path(temporary, "constraints.txt")
        wishes = Path(temporary, "wishes.txt")
        wishes.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
        provided = "".join(f"{name}=={metadata.version(name)}\n" for name in PROVIDED)
        constraints.write_text(provided, encoding="utf-8")
        _pip(
            "--dry-run", "--ignore-installed", "--report", str(report), "-c", str(constraints),
            "-r", str(wishes),
            hint=f"correct {source}; a package must have a wheel for {platform_tag()}",
        )  # fmt: skip
        document = json.loads(report.read_text(encoding="utf-8"))
    if source == lock:
        replace_file(wanted, text.encode())
    chosen = sorted(filter(None, map(_chosen, document["install"])), key=lambda each: each.name)
    write_lock(lock, chosen, f"Locked from {_WANTED_FILE} by rse-pf service lock, for {platform_tag()}.")
    return chosen


def write_lock(path: Path, requirements: Sequence[LockedRequirement], about: str) -> None:
    """Replace the lock *path* by *requirements*, under a comment that says *about*."""
    replace_file(path, "".join(f"{line}\n" for line in (f"# {about}", *(each.line for each in requirements))))


def _install(requirements: Sequence[LockedRequirement], folder: Path, store: Path) -> Dependencies:
    store.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix=".new-", dir=store))
    lock = fresh.with_suffix(".lock")
    try:
        write_lock(lock, requirements, "one installation")
        _pip(
            "--require-hashes", "--no-deps", "--no-compile", "--target", str(fresh.absolute()),
            "-r", str(lock.absolute()),
            hint=f"only wheels with the hashes of the lock are installed: rse-pf service lock {folder}",
        )  # fmt: skip
        shutil.rmtree(fresh / "bin", ignore_errors=True)  # programs, which no sandbox can start
        digest = tree_digest(fresh)
        _settle(fresh, store / digest)
    finally:
        lock.unlink(missing_ok=True)
        shutil.rmtree(fresh, ignore_errors=True)
    packages = {each.name: each.version for each in requirements}
    return Dependencies(folder=store / digest, digest=digest, packages=packages, platform=platform_tag())


def _settle(fresh: Path, target: Path) -> None:
    """Let every user read *fresh*, and nobody write it; then give it its name."""
    for path in (fresh, *fresh.rglob("*")):
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() else 0o444)
    shutil.rmtree(target, ignore_errors=True)
    fresh.rename(target)


def _built(record: Path, store: Path) -> Dependencies | None:
    try:
        document = json.loads(record.read_text(encoding="utf-8"))
        built = Dependencies(**{**document, "folder": store / document["digest"]})
    except (OSError, ValueError, KeyError, TypeError):
        return None
    is_whole = _SHA256.fullmatch(built.digest) and built.folder.is_dir()
    return built if is_whole and tree_digest(built.folder) == built.digest else None


def _text_of(path: Path) -> str | None:
    """Return the text of *path*, None if it is missing."""
    try:
        return read_plain(path).decode("utf-8")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read {path}: {error}", hint="write one package on each line") from error


def _wish(line: str, where: str) -> str:
    """Return *line* as pip shall read it: a name, extras, versions, a marker, and the hashes of a lock."""
    try:
        from packaging.requirements import InvalidRequirement, Requirement
    except ImportError as error:
        raise MissingExtra("packaging", "backend") from error
    locked = _LINE.fullmatch(line)
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
    parsed.name = _normalised(parsed.name)  # a name such as a.zip would be a file
    return f"{parsed}{hashes}"


def _pip(*arguments: str, hint: str) -> None:
    command = [
        sys.executable, "-m", "pip", "install", "--only-binary=:all:", "--quiet", "--no-input",
        "--disable-pip-version-check", *arguments,
    ]  # fmt: skip
    variables = {name: value for name, value in os.environ.items() if name not in _LEFT_OUT_VARIABLES}
    with tempfile.TemporaryDirectory(prefix="rse-pf-pip-") as empty:  # python -m imports from where it runs
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=variables, cwd=empty)
    if done.returncode == 0:
        return
    if "No module named pip" in done.stderr:
        raise UsageError("pip is not installed", hint=f"{sys.executable} -m ensurepip")
    reasons = [line for line in done.stderr.splitlines() if line.startswith("ERROR: ")]
    reason = (reasons or done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[0]
    raise CommandFailed(f"pip: {reason.removeprefix('ERROR: ')[:_MAX_REASON]}", hint=hint)


def _chosen(each: Mapping[str, Any]) -> LockedRequirement | None:
    """Return one package of a report of pip; None if every sandbox provides it."""
    name, version = _normalised(each["metadata"]["name"]), each["metadata"]["version"]
    if name in PROVIDED:
        return None
    sha256 = each["download_info"].get("archive_info", {}).get("hashes", {}).get("sha256", "")
    if not _SHA256.fullmatch(sha256):
        raise CommandFailed(
            f"{name} {version} is not a file with a hash", hint="name a version that an index has"
        )
    return LockedRequirement(name=name, version=version, line=f"{name}=={version} --hash=sha256:{sha256}")


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield number and text of each line; a line that ends with a backslash continues on the next one."""
    number, begun = 0, ""
    for at, raw in enumerate(text.splitlines(), 1):
        number = number if begun else at
        line = f"{begun} {re.sub(r'(^|[ ])#.*', '', raw).strip()}".strip()
        if line.endswith("\\"):
            begun = line[:-1].rstrip() or " "
            continue
        begun = ""
        if line:
            yield number, line
    if begun.strip():
        yield number, begun.strip()


def _why_unlocked(line: str) -> str:
    if line.startswith("-"):
        return "is an option of pip, which a lock does not take"
    if "@" in line or "://" in line or line.startswith((".", "/")):
        return "is an address, not a version of an index"
    return "has no sha256 hash" if _PINNED.match(line) else "is not locked to one version and its hashes"


def _normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
