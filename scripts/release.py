"""Build the packages that can be published, check them, and write their sums and notes: make release.

    python scripts/release.py [--into build/release] [--machines x86_64 aarch64]

Builds the source archive (sdist), the wheel of the platform, and a wheel of the native core for each
machine, all twice: from two copies of the tracked files in different folders, and the second wheel of the
platform from the sdist.  The two builds must be equal, byte by byte.  The time of every entry is
SOURCE_DATE_EPOCH, by default the time of the commit.  Nothing is uploaded, and only the folder of the
results changes.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("rse_pf", "client_sdk", "lambda_pnp", "ros_bridge")
SINGLE_FILES = ("pyproject.toml", "MANIFEST.in", "README.md", "CHANGELOG.md", "LICENSE")
PAGES = (".md", ".json")
"""Of docs/, what the sdist holds; pictures are left out."""
NOT_SHIPPED = ("lambda_pnp/requirements.txt",)
"""The input of a lock."""
MACHINES = ("x86_64", "aarch64")
EARLIEST_ZIP_S = 315532800
MAX_BYTES = {".whl": 2_000_000, ".gz": 3_000_000}
"""More than twice the size in 0.3.0: a larger package holds something that does not belong into it."""
_OF_A_WHEEL = ("METADATA", "WHEEL", "RECORD", "licenses/LICENSE")
_OF_OUR_WHEEL = (*_OF_A_WHEEL, "entry_points.txt", "top_level.txt")
_LIBRARY = ("rse_pf_native/__init__.py", "rse_pf_native/librse_pf_native.so")


class ReleaseError(Exception):
    """There is nothing to publish; ``hint`` says what to do."""

    def __init__(self, message: str, hint: str) -> None:
        super().__init__(message)
        self.hint = hint


@dataclass(frozen=True, slots=True, kw_only=True)
class Origin:
    """Where the files come from: ``commit`` is empty outside of git, ``epoch_s`` the time of all entries."""

    version: str
    commit: str
    changed: int
    epoch_s: int


def main() -> int:
    """Write the folder of the release, or print in two lines why there is none."""
    parser = argparse.ArgumentParser(description="Build and check the packages that can be published.")
    parser.add_argument("--into", type=Path, default=ROOT / "build" / "release", metavar="DIR")
    parser.add_argument(
        "--machines", nargs="*", choices=MACHINES, default=list(MACHINES), help="of the native core"
    )
    args = parser.parse_args()
    try:
        _release(args.into, args.machines)
    except ReleaseError as error:
        sys.stderr.write(f"release: {error}\n  hint: {error.hint}\n")
        return 2
    return 0


def _release(into: Path, machines: Iterable[str]) -> None:
    files = tracked_files(ROOT)
    origin = _origin(files)
    section = changes_of(origin.version, (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))
    compilers = {machine: _compiler(machine) for machine in machines}
    with tempfile.TemporaryDirectory() as place:
        work = Path(place)
        copy = _copy(files, work / "first")
        again = shutil.copytree(copy, work / "and-once-more")  # the checkout may change meanwhile
        first = _build(copy, compilers, origin.epoch_s, "UTC0")
        second = _build(again, compilers, origin.epoch_s, "JST-9")
        for name, package in first.items():
            if package.read_bytes() != second[name].read_bytes():
                raise ReleaseError(
                    f"two builds of {name} differ in {differences(package, second[name])}",
                    "nothing in a package may depend on time, place or machine",
                )
        _check(first.values(), shipped(files))
        into.mkdir(parents=True, exist_ok=True)
        for old in (path for pattern in ("*.whl", "*.tar.gz") for path in into.glob(pattern)):
            old.unlink()
        made = [Path(shutil.copyfile(package, into / name)) for name, package in sorted(first.items())]
    sums = {package.name: hashlib.sha256(package.read_bytes()).hexdigest() for package in made}
    (into / "SHA256SUMS").write_text("".join(f"{digest}  {name}\n" for name, digest in sums.items()), "utf-8")
    sizes = {package.name: package.stat().st_size for package in made}
    (into / "RELEASE_NOTES.md").write_text(notes(origin, section, sizes, sums), "utf-8")
    for name, size in sizes.items():
        sys.stdout.write(f"{into / name}  {size / 1e3:.0f} kB\n")
    sys.stdout.write(f"{into / 'SHA256SUMS'}\n{into / 'RELEASE_NOTES.md'}\n")
    if origin.changed:
        sys.stderr.write(
            f"release: not for publication: {origin.changed} files differ from the commit\n"
            "  hint: commit them, and build again\n"
        )


# --- what belongs into a release --------------------------------------------------------------------


def tracked_files(root: Path) -> list[str]:
    """Return the files of *root* from which packages are built; outside of git, all that look like them."""
    names = _git(root, "ls-files", "-z").split("\0")
    if "pyproject.toml" not in names:
        folders = (*PACKAGES, "examples", "docs", "native")
        files = [file for folder in folders for file in (root / folder).rglob("*")]
        names = [file.relative_to(root).as_posix() for file in files] + list(SINGLE_FILES)
        names = [name for name in names if not re.search(r"(^|/)(__pycache__|build)(/|$)", name)]
    return sorted(name for name in names if _is_used(name) and (root / name).is_file())


def _is_used(name: str) -> bool:
    top = name.partition("/")[0]
    if top == "docs":
        return name.endswith(PAGES)
    return name in SINGLE_FILES or (top in (*PACKAGES, "examples", "native") and name not in NOT_SHIPPED)


def shipped(files: Iterable[str]) -> set[str]:
    """Return those of *files* that the sdist holds; the native core is published as wheels only."""
    return {name for name in files if not name.startswith("native/")}


def changes_of(version: str, changelog: str) -> str:
    """Return the section of *changelog* about *version*; that of 1.2.0 is also for 1.2.0.dev0 and 1.2.0rc1.

    Raises:
        ReleaseError: There is none, or it is empty.
    """
    released = re.match(r"\d+\.\d+\.\d+", version)
    number = released[0] if released else version
    section = re.search(rf"^## {re.escape(number)}\n(.*?)(?=^## |\Z)", changelog, re.M | re.S)
    if section is None or not section[1].strip():
        raise ReleaseError(f"CHANGELOG.md has no section {number}", "write what changed, for its users")
    return section[1].strip()


def _origin(files: Collection[str]) -> Origin:
    version = re.search(r'^version = "(.+)"$', (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.M)
    assert version is not None
    commit = _git(ROOT, "rev-parse", "HEAD") if (ROOT / ".git").exists() else ""
    changed = _git(ROOT, "diff", "--name-only", "HEAD").splitlines() if commit else []
    wanted = os.environ.get("SOURCE_DATE_EPOCH", "")
    wanted = wanted or (_git(ROOT, "log", "-1", "--format=%ct") if commit else "")
    if wanted and not (wanted.isdigit() and int(wanted) >= EARLIEST_ZIP_S):
        raise ReleaseError(
            f"SOURCE_DATE_EPOCH is {wanted!r}", f"use seconds since 1970, at least {EARLIEST_ZIP_S}: 1980"
        )
    return Origin(
        version=version[1],
        commit=commit,
        changed=len(set(changed) & set(files)),
        epoch_s=int(wanted or EARLIEST_ZIP_S),
    )


def _git(root: Path, *words: str) -> str:
    """Return what git says; nothing where there is no git, or *root* is not its checkout."""
    program = shutil.which("git")
    if program is None:
        return ""
    said = subprocess.run([program, "-C", str(root), *words], capture_output=True, text=True, check=False)
    return "" if said.returncode else said.stdout.strip()


# --- building ---------------------------------------------------------------------------------------


def _copy(files: Iterable[str], into: Path) -> Path:
    for name in files:
        target = into / "source" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes((ROOT / name).read_bytes())
        target.chmod(0o644)
    return into


def _build(
    work: Path, compilers: dict[str, tuple[str, ...]], epoch_s: int, time_zone: str
) -> dict[str, Path]:
    """Return the packages that are built from ``work/source``, by name."""
    environment = {**os.environ, "SOURCE_DATE_EPOCH": str(epoch_s), "TZ": time_zone}
    sys.stderr.write(f"release: building {'again' if time_zone != 'UTC0' else 'the packages'}\n")
    source, made = work / "source", work / "made"
    made.mkdir()
    for machine, compiler in compilers.items():
        builder = ("native.wheel_builder", "--into", str(made), "--machine", machine, *compiler)
        _python(f"the native core for {machine}", source, environment, *builder)
    # The folder native is no part of the sdist, as MANIFEST.in says by not naming it.
    _python(
        "the sdist", source, environment, "build", "--sdist", "--no-isolation", "--outdir", str(work), "."
    )
    (sdist,) = work.glob("*.tar.gz")
    packed = repacked(sdist, made, epoch_s)
    input_of_the_wheel = source if time_zone == "UTC0" else packed
    _python(
        "the wheel", work, environment, "pip", "wheel", "--quiet", "--no-deps", "--no-index",
        "--no-build-isolation", "--disable-pip-version-check", "--wheel-dir", str(made),
        str(input_of_the_wheel),
    )  # fmt: skip
    return {package.name: package for package in made.iterdir()}


def _python(what: str, folder: Path, environment: dict[str, str], *words: str) -> None:
    # Wheels store the modes of files that are made here.
    done = subprocess.run(
        [sys.executable, "-m", *words], cwd=folder, env=environment, umask=0o022, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        sys.stderr.write(f"{done.stdout[-3000:]}{done.stderr[-3000:]}")
        raise ReleaseError(f"{what} cannot be built", "read the output above")


def _compiler(machine: str) -> tuple[str, ...]:
    """Return the options of the builder; the compiler for ARM is that of make assets."""
    if machine != "aarch64":
        return ()
    import assets

    program = assets.arm_compiler(ROOT / "build")
    if program is None:
        raise ReleaseError("there is no compiler for aarch64", "leave it out: --machines x86_64")
    return ("--compiler", program)


def repacked(sdist: Path, into: Path, epoch_s: int) -> Path:
    """Write *sdist* into the folder *into*: entries in order, of one time, without owners.

    Setuptools writes the time of its run and the user's name into it.
    """
    made = into / sdist.name
    with (
        tarfile.open(sdist) as archive,
        made.open("wb") as raw,
        gzip.GzipFile(filename="", mode="wb", compresslevel=9, fileobj=raw, mtime=epoch_s) as packed,
        tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as target,
    ):
        for member in sorted(archive.getmembers(), key=lambda each: each.name):
            if not (member.isfile() or member.isdir()):
                raise ReleaseError(f"{member.name} is neither a file nor a folder", "put its content there")
            entry = tarfile.TarInfo(member.name)
            entry.type, entry.size, entry.mtime = member.type, member.size, epoch_s
            entry.mode = 0o755 if member.isdir() else 0o644
            target.addfile(entry, archive.extractfile(member) if member.isfile() else None)
    return made


def differences(first: Path, second: Path) -> str:
    """Return the names of the entries in which two wheels differ; of other files only that they do."""
    if first.suffix != ".whl":
        return "their bytes"
    held = []
    for wheel in (first, second):
        with zipfile.ZipFile(wheel) as archive:
            held.append({(e.filename, e.CRC, e.external_attr, e.date_time) for e in archive.infolist()})
    return ", ".join(sorted({entry[0] for entry in held[0] ^ held[1]})) or "the order or the packing"


# --- checking ---------------------------------------------------------------------------------------


def _check(packages: Collection[Path], files: set[str]) -> None:
    for package in packages:
        wrong = complaints(package, files)
        if wrong:
            raise ReleaseError(
                f"{package.name}: {'; '.join(wrong[:9])}", "see pyproject.toml and MANIFEST.in"
            )
    checked = subprocess.run(
        [sys.executable, "-m", "twine", "--no-color", "check", "--strict", *map(str, packages)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if checked.returncode:
        sys.stderr.write(checked.stdout + checked.stderr)
        raise ReleaseError("twine refuses a package", "read its lines above; make release installs it")


def complaints(package: Path, files: set[str]) -> list[str]:
    """Return what is missing in *package*, what does not belong into it, and whether it is too large.

    Args:
        package: A wheel or an sdist.
        files: What the sdist holds of the checkout; the wheel holds those of the packages.
    """
    if package.suffix == ".whl":
        with zipfile.ZipFile(package) as archive:
            names = set(archive.namelist())
        project, version, *_ = package.name.split("-")
        is_ours = project == "rse_pf"
        information = f"{project}-{version}.dist-info/"
        expected = {information + name for name in (_OF_OUR_WHEEL if is_ours else _OF_A_WHEEL)}
        expected |= {n for n in files if n.startswith(PACKAGES)} if is_ours else set(_LIBRARY)
    else:
        with tarfile.open(package) as archive:
            paths = {member.name.partition("/")[2] for member in archive if member.isfile()}
        names = {name for name in paths if not name.startswith("rse_pf.egg-info/")}
        expected = files | {"PKG-INFO", "setup.cfg"}
    size = package.stat().st_size
    too_large = size > MAX_BYTES[package.suffix]
    return [
        *(f"{name} is missing" for name in sorted(expected - names)),
        *(f"{name} does not belong into it" for name in sorted(names - expected)),
        *([f"{size} bytes are more than {MAX_BYTES[package.suffix]}"] if too_large else []),
    ]


# --- what its readers get ---------------------------------------------------------------------------


def notes(origin: Origin, section: str, sizes: dict[str, int], sums: dict[str, str]) -> str:
    """Return RELEASE_NOTES.md: what is published, how to install and check it, what changed."""
    (wheel,) = (name for name in sizes if name.startswith("rse_pf-") and name.endswith(".whl"))
    (sdist,) = (name for name in sizes if name.endswith(".tar.gz"))
    cores = [name for name in sizes if name.startswith("rse_pf_native-")]
    rows = "\n".join(f"| `{name}` | {sizes[name]} | `{sums[name]}` |" for name in sizes)
    built = f"commit `{origin.commit}`" if origin.commit else "files outside of git"
    if origin.changed:
        built += f"\nwith {origin.changed} files that are not committed: **do not publish them**"
    own = f" ./{next((name for name in cores if 'x86_64' in name), cores[0])}" if cores else ""
    return f"""# RSE-PF {origin.version}

Built from {built}.

The packages were built twice, with equal bytes. To build them again, run
`SOURCE_DATE_EPOCH={origin.epoch_s} make release` on the same commit.

## What is published

Nothing of RSE-PF is in a package index: `pip install rse-pf` does not find it. These files are what there is:

| file | bytes | SHA-256 |
|---|---|---|
{rows}

The wheel `rse_pf` holds the platform, the SDK of robots, the Lambda function and the command `rse-pf`, for
Python 3.10 and newer on Linux. A wheel `rse_pf_native` adds the native core, for every Python on one machine.
The sdist also holds the pages of the documentation and the examples. The CDK stacks, tests, benchmarks and
locks are in the repository only.

## Install it

```
sha256sum --check SHA256SUMS
python3 -m venv robot && . robot/bin/activate
pip install ./{wheel}{own}
pip install 'rse-pf[demo]'    # where the platform runs, too: rse-pf demo
tar xf {sdist}    # for the examples: {sdist.removesuffix(".tar.gz")}/examples
```

With the second `pip install`, pip keeps the installed `rse-pf` and takes only the packages that it needs from
an index.

## What changed

{section}
"""


if __name__ == "__main__":
    sys.exit(main())
