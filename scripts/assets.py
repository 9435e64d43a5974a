"""Build the packages for AWS: archives of a server's Python environment, and the folder of the Lambda
function.

    python scripts/assets.py [--into build] [--arm]

The script installs wheels only, by the hashes of the locks, and runs no downloaded program; with --arm it
runs the compiler of locks/tools.txt.  The build is reproducible: the time of every entry is SOURCE_DATE_EPOCH
(by default the earliest of a zip file).  Nothing is built when neither a lock nor a source has changed; the
network is needed only for a changed lock.

A server unpacks its virtual environment instead of installing it.  The two archives libraries-N.tar.gz hold
the packages of the lock, platform.tar.gz holds the packages of this repository.  The archives of the
libraries are built again only after a change of the lock.

Both packages hold bytecode, because the processes that run them may not write it there.  That needs a Python
of the same version (python3.11 for servers, python3.13 for the function); without one, each start compiles.

The native core is compiled here and goes into both packages.  With --arm its wheel for aarch64 is built, too,
and lies with its hash in build/native.
"""

from __future__ import annotations

import argparse
import configparser
import gzip
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("rse_pf", "client_sdk", "lambda_pnp")  # packages of this repository in the wheel
EPOCH = "315532800"  # default of SOURCE_DATE_EPOCH: 1980-01-01, the earliest time of a zip file
# Packages of this repository in the Lambda function.
LAMBDA_PACKAGES = ("rse_pf", "lambda_pnp")
UNUSED = ("tests", "__pycache__", "f2py", "_pyinstaller", "include", "testing")
"""Folders of wheels that are never used at run time."""
UNUSED_ENDINGS = (".pyi", ".pxd", ".c", ".h", ".a")  # endings of files that are never used at run time
UNUSED_BY_SERVERS = ("tests", "__pycache__", "_pytest", "pytest", "pluggy", "pygments", "iniconfig")
"""Folders that servers never use; a service may use others.  gtsam requires pytest, but never imports it."""
SAMPLES = ("gtsam/Data/", "gtsam_unstable/", "cv2/data/")
"""Folders with data of examples, which are left out: 50 MB."""
APIS = (
    "autoscaling", "cloudwatch", "cloudformation", "ec2", "elbv2", "lambda", "logs", "s3", "secretsmanager",
    "sns", "sqs", "ssm", "sts",
)  # fmt: skip
"""AWS services that a server may call; of botocore's descriptions only theirs are packed, since those of all
400 services are 30 MB in 2,000 files."""
DEBIAN_12 = ("3.11", 36)  # Python, and minor version of glibc 2, of servers
AMAZON_2023 = ("3.13", 34)  # Python, and minor version of glibc 2, of the Lambda function
FUNCTION_FOLDER = "/var/task"
"""Folder in which Lambda unpacks the function, as its tracebacks name it."""
ENVIRONMENT = "/opt/rse-pf/venv"
"""Folder in which a server unpacks its environment, see stacks/boot/install.py."""
LIBRARIES = ("libraries-0.tar.gz", "libraries-1.tar.gz")
"""Archives of the libraries, of about the same size, which a server unpacks concurrently."""
PLATFORM = "platform.tar.gz"  # archive of the packages of this repository
ENVIRONMENT_FILE = "environment.json"  # file with the inputs and the target of the archives
# Files of the native core from which it is compiled.
NATIVE_SOURCES = ("src/*.cpp", "src/*.hpp", "include/*.h", "*.py", "Makefile", "*.toml", "*.md")


def main() -> int:
    """Build the packages of servers and function, or print why that failed; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--into", type=Path, default=ROOT / "build", metavar="DIR")
    parser.add_argument("--arm", action="store_true", help="build the native core for aarch64, too (100 MB)")
    args = parser.parse_args()
    status = _packages(args.into)
    return status or (_native_for_arm(args.into) if args.arm else 0)


def _packages(into: Path) -> int:
    stamp = into / "assets.sha256"
    wanted = _state_of_the_sources()
    if stamp.is_file() and stamp.read_text(encoding="utf-8") == wanted:
        return 0
    sys.stderr.write("assets: building the packages of the cloud (once per change)\n")
    stamp.unlink(missing_ok=True)
    try:
        with tempfile.TemporaryDirectory() as work:
            ours = _our_wheel(Path(work))
            core = _native_wheel(into / "native", "x86_64")
            _wheelhouse(into / "wheelhouse", [ours, core], into / "downloads" / "boot")
            _servers(into / "servers", [ours, core], into / "downloads")
            _function(into / "lambda", ours, core, into / "downloads" / "lambda")
    except subprocess.CalledProcessError as error:
        return _report_failure(error)
    stamp.write_text(wanted, encoding="utf-8")
    for name in ("servers", "lambda"):
        size = sum(file.stat().st_size for file in (into / name).rglob("*") if file.is_file())
        sys.stderr.write(f"assets: {into / name} {size / 1e6:.1f} MB\n")
    return 0


def _sources() -> list[Path]:
    files = [
        file
        for package in PACKAGES
        for file in (ROOT / package).rglob("*")
        if file.is_file() and file.suffix != ".pyc"
    ]
    files += [ROOT / name for name in ("pyproject.toml", "README.md", "LICENSE")]
    return sorted(file for file in files if "__pycache__" not in file.parts)


def _state_of_the_sources() -> str:
    state = hashlib.sha256(os.environ.get("SOURCE_DATE_EPOCH", EPOCH).encode())
    pythons = [_python_of(version) is not None for version in (DEBIAN_12[0], AMAZON_2023[0])]
    state.update(f"bytecode: {pythons}\0".encode())
    native = sorted(file for pattern in NATIVE_SOURCES for file in (ROOT / "native").glob(pattern))
    locks = [ROOT / "locks/boot.txt", ROOT / "locks/lambda.txt"]
    for file in [*_sources(), *native, Path(__file__), *locks]:
        state.update(f"{file.relative_to(ROOT)}\0".encode() + hashlib.sha256(file.read_bytes()).digest())
    return state.hexdigest() + "\n"


def _our_wheel(work: Path) -> Path:
    """Build the wheel of this repository from a copy of the sources, without files of an earlier build."""
    copy = work / "source"
    for file in _sources():
        target = copy / file.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(file.read_bytes())
        target.chmod(0o644)
    _pip(
        "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(work / "ours"), str(copy)
    )
    (wheel,) = (work / "ours").glob("rse_pf-*.whl")
    return wheel


def _native_wheel(folder: Path, machine: str) -> Path:
    """Build and return the wheel of the native core for *machine*."""
    folder.mkdir(parents=True, exist_ok=True)
    pattern = f"rse_pf_native-*_{machine}.whl"
    for old in folder.glob(pattern):
        old.unlink()
    subprocess.run(
        ["/bin/sh", str(ROOT / "scripts/native_wheel.sh"), str(folder.resolve()), machine],
        check=True, env={"SOURCE_DATE_EPOCH": EPOCH, **os.environ},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    (wheel,) = folder.glob(pattern)
    return wheel


def _native_for_arm(into: Path) -> int:
    """Build the wheel for ARM robots and Graviton servers."""
    folder = into / "native"
    try:
        _native_wheel(folder, "aarch64")
    except subprocess.CalledProcessError as error:
        return _report_failure(error)
    _write_hashes(folder)
    sys.stderr.write(
        f"assets: {folder} holds {', '.join(file.name for file in sorted(folder.glob('*.whl')))}\n"
    )
    return 0


def _report_failure(error: subprocess.CalledProcessError) -> int:
    """Print the end of the output of a command that failed, with a hint; return the exit status."""
    sys.stderr.write(
        f"{(error.output or '')[-3000:]}assets: {' '.join(error.cmd[:4])} failed\n"
        "  hint: read the output above, and check the network\n"
    )
    return 2


def _wheelhouse(folder: Path, ours: list[Path], wheels: Path) -> None:
    """Put all wheels of a server into *folder*, with a list of their hashes for pip."""
    _empty(folder)
    _download(ROOT / "locks/boot.txt", wheels, *DEBIAN_12)
    for wheel in (*wheels.glob("*.whl"), *ours):
        shutil.copyfile(wheel, folder / wheel.name)
    _write_hashes(folder)


def _write_hashes(folder: Path) -> None:
    """Name every wheel of *folder* with its version and hash, as pip requires them."""
    hashes: dict[str, str] = {}
    for wheel in sorted(folder.glob("*.whl")):
        name, version, *_ = wheel.name.split("-")
        hash_option = f" --hash=sha256:{hashlib.sha256(wheel.read_bytes()).hexdigest()}"
        hashes[f"{name}=={version}"] = hashes.get(f"{name}=={version}", "") + hash_option
    lines = [f"{package}{options}\n" for package, options in hashes.items()]
    (folder / "requirements.txt").write_text("".join(lines), encoding="utf-8")


def _servers(folder: Path, ours: list[Path], downloads: Path) -> None:
    """Write the archives of a server's environment into *folder*, and a file with their inputs and target."""
    _empty(folder)
    for archive in _libraries(downloads):
        shutil.copyfile(archive, folder / archive.name)
    with tempfile.TemporaryDirectory() as work:
        tree = Path(work)
        site = tree / "lib" / f"python{DEBIAN_12[0]}" / "site-packages"
        for wheel in ours:
            _unpack(wheel, site, None, (), ())
        has_bytecode = _compile(tree, DEBIAN_12[0], ENVIRONMENT)
        (tree / "pyvenv.cfg").write_text(
            f"home = /usr/bin\ninclude-system-site-packages = false\nversion = {DEBIAN_12[0]}\n",
            encoding="utf-8",
        )
        (tree / "bin").mkdir()
        for name in ("python", "python3"):
            (tree / "bin" / name).symlink_to("/usr/bin/python3")
        _write_scripts(site, tree / "bin")
        _pack(tree, folder / PLATFORM)
        sources = {
            file.relative_to(site).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
            for file in sorted((site / "rse_pf").rglob("*.py"))
        }
    about = {"python": DEBIAN_12[0], "bytecode": has_bytecode, "sources": sources}
    (folder / ENVIRONMENT_FILE).write_text(json.dumps(about, sort_keys=True) + "\n", encoding="utf-8")


def _libraries(downloads: Path) -> list[Path]:
    """Return the archives of the packages in the servers' lock; build them only if the lock has changed."""
    archives, stamp = [downloads / name for name in LIBRARIES], downloads / "libraries.sha256"
    state = hashlib.sha256(Path(__file__).read_bytes() + (ROOT / "locks/boot.txt").read_bytes())
    state.update(f"{_python_of(DEBIAN_12[0]) is not None}".encode())
    wanted = state.hexdigest()
    have_all = all(archive.is_file() for archive in archives)
    if have_all and stamp.is_file() and stamp.read_text(encoding="utf-8") == wanted:
        return archives
    stamp.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as work:
        site = Path(work) / "lib" / f"python{DEBIAN_12[0]}" / "site-packages"
        for wheel in sorted((downloads / "boot").glob("*.whl")):
            _unpack(wheel, site, None, UNUSED_BY_SERVERS)
        _leave_out(site)
        _compile(Path(work), DEBIAN_12[0], ENVIRONMENT)
        for archive, part in zip(archives, _halves(Path(work)), strict=True):
            _pack(Path(work), archive, part)
    stamp.write_text(wanted, encoding="utf-8")
    return archives


def _leave_out(site: Path) -> None:
    """Delete the files below *site* that no server uses."""
    for name in SAMPLES:
        shutil.rmtree(site / name, ignore_errors=True)
    for api in (site / "botocore" / "data").iterdir():
        if api.is_dir() and api.name not in APIS:
            shutil.rmtree(api)


def _halves(tree: Path) -> tuple[list[Path], list[Path]]:
    """Divide the files of *tree* into two sorted lists of about the same total size."""
    halves: tuple[list[Path], list[Path]] = ([], [])
    sizes = [0, 0]
    files = [path for path in tree.rglob("*") if path.is_file()]
    for file in sorted(files, key=lambda each: (-each.stat().st_size, each)):
        smaller = sizes.index(min(sizes))
        halves[smaller].append(file)
        sizes[smaller] += file.stat().st_size
    return sorted(halves[0]), sorted(halves[1])


def _write_scripts(site: Path, folder: Path) -> None:
    """Write to *folder* a script for each command that a wheel in *site* declares, as an installer does."""
    for declared in sorted(site.glob("*.dist-info/entry_points.txt")):
        points = configparser.ConfigParser()
        points.read(declared, encoding="utf-8")
        for name, place in points.items("console_scripts") if points.has_section("console_scripts") else ():
            module, _, function = place.partition(":")
            (folder / name).write_text(
                f"#!{ENVIRONMENT}/bin/python\nimport sys\nfrom {module} import {function}\n\n"
                f"sys.exit({function}())\n",
                encoding="utf-8",
            )
            (folder / name).chmod(0o755)


def _pack(tree: Path, archive: Path, paths: list[Path] | None = None) -> None:
    """Write *tree*, or *paths* of it, into *archive*; the same tree gives the same bytes."""
    epoch = int(os.environ.get("SOURCE_DATE_EPOCH", EPOCH))

    def same(entry: tarfile.TarInfo) -> tarfile.TarInfo:
        entry.mtime, entry.uid, entry.gid, entry.uname, entry.gname = epoch, 0, 0, "root", "root"
        entry.mode = 0o755 if entry.isdir() or entry.mode & 0o100 else 0o644
        return entry

    with (
        archive.open("wb") as file,
        gzip.GzipFile("", "wb", compresslevel=6, fileobj=file, mtime=epoch) as packed,
        tarfile.open(fileobj=packed, mode="w", format=tarfile.GNU_FORMAT) as made,
    ):
        for path in sorted(tree.rglob("*")) if paths is None else paths:
            made.add(path, path.relative_to(tree).as_posix(), recursive=False, filter=same)


def _function(folder: Path, ours: Path, core: Path, wheels: Path) -> None:
    """Unpack the function's wheels into *folder*, without files that are never used."""
    _empty(folder)
    _download(ROOT / "locks/lambda.txt", wheels, *AMAZON_2023)
    for wheel in (*sorted(wheels.glob("*.whl")), core):
        _unpack(wheel, folder, None)
    _unpack(ours, folder, LAMBDA_PACKAGES)
    _compile(folder, AMAZON_2023[0], FUNCTION_FOLDER)


def _compile(folder: Path, version: str, runs_in: str) -> bool:
    """Compile *folder* to bytecode for its later path *runs_in*; return whether a Python *version* was found.

    The same sources give the same bytecode.
    """
    python = _python_of(version)
    if python is None:
        sys.stderr.write(
            f"assets: no Python {version} is in the path: what is in {runs_in} compiles at each cold start\n"
            f"  hint: install python{version}, and run make assets again\n"
        )
        return False
    subprocess.run(
        [
            python, "-P", "-S", "-s", "-m", "compileall", "-q", "--invalidation-mode", "unchecked-hash",
            "-s", str(folder), "-p", runs_in, str(folder),
        ],
        check=True, env={**os.environ, "PYTHONHASHSEED": "0"}, stdout=sys.stderr,
    )  # fmt: skip
    return True


def _python_of(wanted: str) -> str | None:
    """Return a Python of the version *wanted*, None if there is none."""
    for python in (shutil.which(f"python{wanted}"), sys.executable):
        command = [python or "", "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
        if python and subprocess.run(command, capture_output=True, text=True).stdout.strip() == wanted:
            return python
    return None


def _unpack(
    wheel: Path,
    folder: Path,
    only: tuple[str, ...] | None,
    without: tuple[str, ...] = UNUSED,
    endings: tuple[str, ...] = UNUSED_ENDINGS,
) -> None:
    """Unpack *wheel* into *folder*, except for folders named in *without* and files with *endings*."""
    with zipfile.ZipFile(wheel) as archive:
        for name in sorted(archive.namelist()):
            parts = Path(name).parts
            if len(parts) > 2 and parts[0].endswith(".data"):
                if parts[1] not in ("purelib", "platlib"):
                    continue  # files of a wheel that are installed elsewhere, such as scripts and headers
                parts = parts[2:]
            unused = set(parts[:-1]) & set(without) or name.endswith((*endings, "/"))
            if unused or (only and parts[0] not in only and not parts[0].endswith(".dist-info")):
                continue
            target = folder.joinpath(*parts)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(archive.read(name))
            target.chmod(0o644)


def _download(lock: Path, folder: Path, python: str, glibc: int) -> None:
    """Download the wheels of *lock* for a Python and a glibc 2.x into *folder*, unless they are there."""
    stamp, wanted = folder / "lock.sha256", hashlib.sha256(lock.read_bytes()).hexdigest()
    if stamp.is_file() and stamp.read_text(encoding="utf-8") == wanted:
        return
    _empty(folder)
    tags = [f"manylinux_2_{minor}_x86_64" for minor in range(glibc, 4, -1)]
    tags += ["manylinux2014_x86_64", "manylinux2010_x86_64", "manylinux1_x86_64"]
    platforms = [part for tag in tags for part in ("--platform", tag)]
    _pip(
        "download", "--quiet", "--require-hashes", "--no-deps", "--only-binary=:all:", "--implementation=cp",
        f"--python-version={python}", *platforms, "--dest", str(folder), "--requirement", str(lock),
    )  # fmt: skip
    stamp.write_text(wanted, encoding="utf-8")


def _pip(verb: str, *arguments: str) -> None:
    environment = {"SOURCE_DATE_EPOCH": EPOCH, **os.environ}
    subprocess.run(
        [sys.executable, "-m", "pip", verb, "--disable-pip-version-check", *arguments],
        check=True, env=environment, stdout=sys.stderr,
    )  # fmt: skip


def _empty(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)


if __name__ == "__main__":
    sys.exit(main())
