"""scripts/native.sh compiles the native core once, with a compiler of the system or the ziglang wheel."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from rse_pf.pnp.native_solver import native_solver, open_solver

COMPILER = """#!/bin/sh
# Stands in for a compiler: writes what -o names.
echo "$@" >> {log}
[ "$1" = -dumpmachine ] && echo x86_64-linux-gnu && exit 0
while [ $# -gt 0 ]; do [ "$1" = -o ] && : > "$2"; shift; done
exit {status}
"""
TOOLS = ("sh", "make", "dirname", "mkdir", "rm", "mv", "uname", "sed", "cat")


class Checkout:
    """A copy of the files that the script needs, and a PATH with few programs."""

    def __init__(self, folder: Path, repository: Path) -> None:
        self.folder, self.programs, self.log = folder / "checkout", folder / "bin", folder / "calls"
        shutil.copytree(repository / "native", self.folder / "native", ignore=shutil.ignore_patterns("build"))
        (self.folder / "scripts").mkdir()
        shutil.copy(repository / "scripts/native.sh", self.folder / "scripts")
        self.programs.mkdir()
        for tool in TOOLS:
            found = shutil.which(tool)
            if found is None:
                pytest.skip(f"no {tool}")
            (self.programs / tool).symlink_to(found)

    @property
    def built(self) -> Path:
        """Path of the compiled library."""
        return self.folder / "native/build/librse_pf_native.so"

    def add_compiler(self, name: str, status: int = 0) -> Path:
        """Install a program that stands in for a compiler, and return its path."""
        program = self.programs / name
        program.write_text(COMPILER.format(log=self.log, status=status), encoding="utf-8")
        program.chmod(0o755)
        return program

    def add_ziglang(self, status: int = 0) -> None:
        """Let the installation of ziglang exit with *status*; its compiler succeeds."""
        (self.folder / "scripts/tool.sh").write_text(f"exit {status}\n", encoding="utf-8")
        zig = self.folder / "build/ziglang/ziglang/zig"
        zig.parent.mkdir(parents=True)
        self.add_compiler("zig").rename(zig)

    def set_up(self, *, timeout_s: float = 60, **variables: str) -> subprocess.CompletedProcess[str]:
        """Run the script."""
        return subprocess.run(
            ["sh", "scripts/native.sh"], cwd=self.folder, capture_output=True, text=True, timeout=timeout_s,
            check=False, env={"PATH": str(self.programs), **variables},
        )  # fmt: skip

    def compilations(self) -> int:
        """Return how often a source was compiled."""
        if not self.log.exists():
            return 0
        return sum(" -c " in line for line in self.log.read_text(encoding="utf-8").splitlines())


@pytest.fixture
def checkout(tmp_path: Path, repository: Path) -> Checkout:
    return Checkout(tmp_path, repository)


@pytest.mark.parametrize("name", ["c++", "g++", "clang++"])
def test_any_compiler_is_found_and_its_library_is_put_where_it_is_looked_for(
    checkout: Checkout, name: str
) -> None:
    checkout.add_compiler(name)

    told = checkout.set_up()

    assert (told.returncode, told.stderr) == (0, "")
    assert f"/{name} " in told.stdout
    assert checkout.built.is_file()


def test_nothing_is_compiled_again_until_a_source_changes(checkout: Checkout) -> None:
    checkout.add_compiler("c++")
    checkout.set_up()
    first = checkout.compilations()

    again = checkout.set_up()
    unchanged = checkout.compilations()
    header = next(checkout.folder.glob("native/src/*.hpp"))
    later = checkout.built.stat().st_mtime + 10
    os.utime(header, (later, later))
    checkout.set_up()

    assert first > 1
    assert again.stdout == ""
    assert unchanged == first
    assert checkout.compilations() == 2 * first


@pytest.mark.parametrize("status", [None, 1])
def test_where_no_compiler_works_that_of_the_ziglang_wheel_compiles(
    checkout: Checkout, status: int | None
) -> None:
    if status is not None:
        checkout.add_compiler("c++", status)
    checkout.add_ziglang()

    done = checkout.set_up()

    assert (done.returncode, done.stderr) == (0, "")
    assert "zig c++ -target" in done.stdout
    assert checkout.built.is_file()


def test_without_a_compiler_and_without_ziglang_the_setup_fails_with_a_hint(checkout: Checkout) -> None:
    checkout.add_ziglang(status=1)

    done = checkout.set_up()

    assert done.returncode == 2
    assert "no C++ compiler works here, and ziglang cannot be installed\n  hint: sudo" in done.stderr


def test_a_chosen_compiler_that_fails_stops_the_setup_and_leaves_no_old_library(checkout: Checkout) -> None:
    checkout.built.parent.mkdir()
    checkout.built.write_bytes(b"of older sources")
    os.utime(checkout.built, (0, 0))

    done = checkout.set_up(CXX="no-such-compiler")

    assert done.returncode == 2
    assert "does not compile with no-such-compiler\n  hint: read build/native.log" in done.stderr
    assert not checkout.built.exists()


@pytest.mark.slow
@pytest.mark.timeout(900)  # with an empty cache zig builds its own C++ library first
def test_ziglang_builds_a_core_with_the_instructions_of_the_processor(
    checkout: Checkout, repository: Path
) -> None:
    if not (repository / "build/ziglang/locked.txt").is_file():
        pytest.skip("no ziglang: run make assets")
    for name in ("locks", "scripts/tool.sh", "build/ziglang", "build/zig-cache"):
        (checkout.folder / name).parent.mkdir(exist_ok=True)
        (checkout.folder / name).symlink_to((repository / name).resolve())

    done = checkout.set_up(timeout_s=800)

    assert (done.returncode, done.stderr) == (0, "")
    assert open_solver(checkout.built).lanes == native_solver().lanes


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_the_sanitizers_find_nothing(repository: Path) -> None:
    told = subprocess.run(
        ["sh", "scripts/sanitize.sh"],
        cwd=repository,
        capture_output=True,
        text=True,
        timeout=1400,
        check=False,
    )

    if "sanitize: skipped" in told.stdout:
        pytest.skip(told.stdout.strip())
    assert told.returncode == 0, told.stdout[-3000:] + told.stderr[-3000:]
    assert "sanitize: no findings" in told.stdout
