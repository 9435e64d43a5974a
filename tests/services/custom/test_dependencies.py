"""Python packages of a service: valid locks, installation by pip, and refusal of changed packages."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rse_pf.config import PlatformSettings
from rse_pf.errors import CommandFailed, ConfigurationError, UsageError
from rse_pf.server.sandbox.dry_run import dry_run
from rse_pf.services.custom import dependencies
from rse_pf.services.custom.dependencies import (
    Dependencies,
    build_dependencies,
    lock_dependencies,
    platform_tag,
    read_lock,
    tree_digest,
)
from rse_pf.services.custom.installed import install, installed_services, read_service
from rse_pf.wire import Result

HASH = "--hash=sha256:" + "a" * 64
SOURCE = """
import errno, os, sys
import msgspec
import greeting

class Request(msgspec.Struct): pass
class Reply(msgspec.Struct):
    said: str
    first: str
    write: str
    make: str

def why(function, *arguments):
    try: function(*arguments)
    except OSError as error: return errno.errorcode[error.errno]
    return "done"

def serve(request: Request) -> Reply:
    folder = os.path.dirname(greeting.__file__)
    return Reply(said=greeting.SAID, first=sys.path[0], write=why(open, greeting.__file__, "a"),
                 make=why(os.mkdir, os.path.join(folder, "more")))
"""


def make_wheel(folder: Path, name: str, version: str, source: str) -> Path:
    """Write a wheel with one package into *folder*."""
    path = folder / f"{name}-{version}-py3-none-any.whl"
    about = f"{name}-{version}.dist-info"
    files = {
        f"{name}/__init__.py": source,
        f"{about}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n",
        f"{about}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    files[f"{about}/RECORD"] = "".join(f"{each},,\n" for each in (*files, f"{about}/RECORD"))
    with zipfile.ZipFile(path, "w") as wheel:
        for each, text in files.items():
            wheel.writestr(each, text)
    return path


def write_service(folder: Path, name: str, source: str = SOURCE) -> Path:
    made = folder / name
    made.mkdir()
    (made / "service.json").write_text(
        json.dumps({"name": name, "language": "python", "entry": "service.py"})
    )
    (made / "service.py").write_text(source)
    return made


@pytest.fixture(scope="module")
def index(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder of wheels that pip takes for the only index."""
    folder = tmp_path_factory.mktemp("index")
    make_wheel(folder, "greeting", "1.2", "SAID = 'hello'\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PIP_NO_INDEX", "1")
        patch.setenv("PIP_FIND_LINKS", str(folder))
        patch.setenv("PIP_CONFIG_FILE", "/dev/null")
        yield folder


@pytest.fixture(scope="module")
def built(index: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Dependencies]:
    """A service that locks a package, the folder of packages, and what was installed there."""
    folder = tmp_path_factory.mktemp("author")
    service = write_service(folder, "polite")
    (service / "requirements.txt").write_text("greeting>=1\n")
    lock_dependencies(service)
    made = build_dependencies(service, folder / "packages")
    assert made is not None
    return service, folder / "packages", made


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("greeting", "not locked to one version"),
        ("greeting>=1.0", "not locked to one version"),
        ("greeting==1.2", "has no sha256 hash"),
        ("greeting==1.2 --hash=md5:00", "has no sha256 hash"),
        (f"greeting==1.* {HASH}", "has no sha256 hash"),
        ("-e .", "an option of pip"),
        ("--index-url http://127.0.0.1/", "an option of pip"),
        ("-r more.txt", "an option of pip"),
        (f"greeting==1.2 {HASH} --global-option=x", "has no sha256 hash"),
        ("greeting @ http://127.0.0.1/greeting.whl", "is an address"),
        ("./greeting", "is an address"),
        (f"greeting==1.2 ; python_version > '3' --index-url=x {HASH}", "has no sha256 hash"),
        (f"greeting==1.2 ; python_version > '${{HOME}}' {HASH}", "has no sha256 hash"),
        (f"numpy==1.26.0 {HASH}", "every sandbox has numpy"),
        (f"greeting==1.2 {HASH}\nGreeting==1.3 {HASH}", "locked twice"),
    ],
)
def test_what_is_not_locked_is_refused_with_its_line_and_how_to_lock_it(
    tmp_path: Path, line: str, says: str
) -> None:
    (tmp_path / "requirements.txt").write_text(f"# a comment\n{line}\n")

    with pytest.raises(UsageError, match=says) as told:
        read_lock(tmp_path)
    assert "requirements.txt, line " in told.value.message
    assert "rse-pf service lock" in told.value.hint


def test_a_lock_holds_versions_and_hashes_and_the_wish_is_kept(
    built: tuple[Path, Path, Dependencies],
) -> None:
    service, _, made = built

    (locked,) = read_lock(service)
    assert (locked.name, locked.version) == ("greeting", "1.2")
    assert (service / "requirements.in").read_text() == "greeting>=1\n"
    assert (made.packages, made.platform) == ({"greeting": "1.2"}, platform_tag())
    assert made.folder.name == made.digest == tree_digest(made.folder)


def test_packages_that_were_changed_are_installed_again(
    built: tuple[Path, Path, Dependencies], monkeypatch: pytest.MonkeyPatch
) -> None:
    service, store, made = built
    (made.folder / "greeting" / "more.py").write_text("")
    monkeypatch.setattr(dependencies, "_install", lambda *_: made)

    build_dependencies(service, store)

    (made.folder / "greeting" / "more.py").unlink()
    assert tree_digest(made.folder) == made.digest


def run_it(service: Path, made: Dependencies) -> Any:
    """Return the reply of the service in a sandbox."""
    chosen = dataclasses.replace(read_service(service), dependencies=made.folder)
    _, (run,) = dry_run(chosen, [{}], PlatformSettings(), lambda _: None)
    assert isinstance(run.answer, Result), run.answer
    return run.answer.reply


@pytest.mark.system
def test_a_sandbox_imports_the_packages_first_and_cannot_change_them(
    built: tuple[Path, Path, Dependencies],
) -> None:
    service, _, made = built

    reply = run_it(service, made)

    assert reply == {"said": "hello", "first": str(made.folder), "write": reply["write"], "make": "EROFS"}
    assert reply["write"] in ("EROFS", "EACCES")


def test_an_installed_service_carries_its_packages_in_its_identity(
    built: tuple[Path, Path, Dependencies], tmp_path: Path
) -> None:
    service, _, made = built

    with pytest.raises(UsageError, match="packages of polite are not installed"):
        install(service, tmp_path)
    installed = install(service, tmp_path, made)

    assert installed.dependencies == tmp_path / ".dependencies" / made.digest
    assert installed_services(tmp_path) == [installed]
    other = dataclasses.replace(made, digest="0" * 64)
    (tmp_path / ".dependencies" / other.digest).mkdir()
    assert install(service, tmp_path, other).identity != installed.identity


@pytest.mark.parametrize("change", ["a byte", "a file", "a missing folder"])
def test_a_server_refuses_packages_that_were_changed_after_the_installation(
    built: tuple[Path, Path, Dependencies], tmp_path: Path, change: str
) -> None:
    service, _, made = built
    folder = install(service, tmp_path, made).dependencies
    assert folder is not None
    source = folder / "greeting" / "__init__.py"
    source.chmod(0o644)
    if change == "a byte":
        source.write_text("SAID = 'hullo'\n")
    elif change == "a file":
        (folder / "more.py").write_text("")
    else:
        folder.rename(tmp_path / ".away")

    with pytest.raises(ConfigurationError, match=r"packages of polite (were changed|are missing)") as told:
        installed_services(tmp_path)
    assert "rse-pf service install" in told.value.hint


def test_packages_of_another_interpreter_are_refused(
    built: tuple[Path, Path, Dependencies], tmp_path: Path
) -> None:
    service, _, made = built
    install(service, tmp_path, dataclasses.replace(made, platform="cp27-linux-sparc"))

    with pytest.raises(ConfigurationError, match=r"are for cp27-linux-sparc, this server is cp3"):
        installed_services(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["another hash", "no wheel"])
def test_what_has_no_wheel_or_another_hash_is_not_installed(index: Path, tmp_path: Path, wrong: str) -> None:
    service = write_service(tmp_path, "rude")
    name = "greeting" if wrong == "another hash" else "sourceonly"
    (index / "sourceonly-1.2.tar.gz").write_bytes(b"an archive of sources")
    (service / "requirements.txt").write_text(f"{name}==1.2 {HASH}\n")

    with pytest.raises(CommandFailed, match="pip: ") as told:
        build_dependencies(service, tmp_path / "store")

    assert "only wheels with the hashes of the lock" in told.value.hint
    assert "\n" not in told.value.message
    assert list((tmp_path / "store").iterdir()) == []


HOSTILE = [
    "./evil", "evil/", "/evil", "../evil", "evil.zip/", "-e ./evil", "-e.", "--editable=./evil",
    "-r more.txt", "-c more.txt", "--index-url http://127.0.0.1:1/", "--extra-index-url=http://127.0.0.1:1/",
    "--find-links .", "--no-binary :all:", "--pre", "--trusted-host x", "evil @ file:/evil",
    "evil @ ./evil", "evil@http://127.0.0.1:1/e.whl", "git+https://127.0.0.1:1/evil",
    "http://127.0.0.1:1/evil-1-py3-none-any.whl", "file:evil", "evil===${HOME}", "${EVIL}",
    "evil ; python_version > '${HOME}'", "evil --config-settings=x=y", "evil --global-option=x",
    "evil \\\n-r more.txt", "evil extra", "[evil]", "\x00",
]  # fmt: skip


@pytest.mark.parametrize("line", HOSTILE)
@pytest.mark.parametrize("name", ["requirements.in", "requirements.txt"])
def test_a_wish_that_is_more_than_a_name_with_versions_is_refused_before_pip_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, name: str
) -> None:
    def run(*_: object, **__: object) -> None:
        raise AssertionError("a program was started")

    monkeypatch.setattr(subprocess, "run", run)
    service = write_service(tmp_path, "rude")
    (service / name).write_text(f"# a comment\nscipy\n{line}\n")

    with pytest.raises(UsageError, match=f"{name}, line 3: ") as told:
        lock_dependencies(service)
    assert "scipy>=1.11" in told.value.hint
    assert "\n" not in told.value.message


def test_names_extras_versions_and_markers_reach_pip_from_a_folder_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[str, list[str]]] = []

    def run(command: list[str], *, cwd: str, **_: object) -> subprocess.CompletedProcess[str]:
        wishes = Path(command[command.index("-r") + 1]).read_text()
        Path(command[command.index("--report") + 1]).write_text('{"install": []}')
        seen.append((wishes, sorted(path.name for path in Path(cwd).iterdir())))
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", run)
    service = write_service(tmp_path, "tidy")
    locked = f"pinned==1.0 {HASH}"
    (service / "requirements.in").write_text(
        f"SciPy >= 1.11 , < 2  # fast\na.zip\nb[fast]~=1.0; python_version>'3'\n{locked}\n"
    )

    lock_dependencies(service)

    expected = ["scipy<2,>=1.11", "a-zip", 'b[fast]~=1.0; python_version > "3"', locked]
    assert seen == [("".join(f"{line}\n" for line in expected), [])]


def test_nothing_of_a_hostile_folder_runs_when_it_is_locked_from_inside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mark = tmp_path / "ran"
    hostile = f"open({str(mark)!r}, 'a').write(__name__)\nraise SystemExit(1)\n"
    service = write_service(tmp_path, "rude", hostile)
    for place in ("setup.py", "pip.py", "json.py", "evil/setup.py", "evil/backend.py", "sitecustomize.py"):
        (service / place).parent.mkdir(exist_ok=True)
        (service / place).write_text(hostile)
    project = '[build-system]\nrequires = []\nbuild-backend = "backend"\nbackend-path = ["."]\n'
    (service / "evil" / "pyproject.toml").write_text(project)
    monkeypatch.chdir(service)
    for name, value in (("PIP_NO_INDEX", "1"), ("PIP_CONFIG_FILE", "/dev/null")):
        monkeypatch.setenv(name, value)

    for wish in ("./evil", "evil"):
        Path("requirements.in").write_text(f"{wish}\n")
        with pytest.raises((UsageError, CommandFailed)):
            lock_dependencies(Path())

    assert not mark.exists()


@pytest.mark.parametrize("name", ["requirements.in", "requirements.txt"])
def test_a_wish_behind_a_link_is_not_read(tmp_path: Path, name: str) -> None:
    service = write_service(tmp_path, "rude")
    (tmp_path / "secret").write_text("a secret\n")
    (service / name).symlink_to(tmp_path / "secret")

    with pytest.raises(UsageError, match="is a link") as told:
        lock_dependencies(service)
    assert "a secret" not in told.value.message


@pytest.mark.slow
def test_a_package_that_no_index_has_cannot_be_locked(index: Path, tmp_path: Path) -> None:
    service = write_service(tmp_path, "rude")
    (service / "requirements.in").write_text("no-such-package-of-anybody\n")

    with pytest.raises(CommandFailed, match="no-such-package-of-anybody"):
        lock_dependencies(service)
    assert not (service / "requirements.txt").exists()
