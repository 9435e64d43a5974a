"""The wheel of the native core: any Python, old systems, nothing but the C library, the same bytes again."""

from __future__ import annotations

import base64
import hashlib
import platform
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from native.wheel_builder.backend import LIBRARY, NATIVE, BuildError, compiled, pack
from native.wheel_builder.elf import ElfError, SharedLibrary, complaints, read_library
from rse_pf.native import open_solver

MACHINE = platform.machine()
AARCH64 = NATIVE / "build" / "aarch64" / LIBRARY


@pytest.fixture(scope="module")
def library() -> Path:
    """The library of this checkout, as `make setup` compiled it."""
    path = NATIVE / "build" / LIBRARY
    if not path.is_file():
        pytest.skip("the native core is not built: make setup with a C++ compiler")
    return path


def with_executable_stack(data: bytes) -> bytes:
    at = data.index(struct.pack("<II", 0x6474E551, 6))
    return data[: at + 4] + struct.pack("<I", 7) + data[at + 8 :]


def replaced(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    """Return a function that puts *new* for *old*, padded to its length."""
    return lambda data: data.replace(old + b"\0", new.ljust(len(old), b"\0") + b"\0")


def test_the_library_may_be_shipped(library: Path) -> None:
    asked = read_library(library.read_bytes())

    assert complaints(asked, MACHINE) == []
    assert asked.machine == MACHINE
    assert "libc.so.6" in asked.needed
    assert asked.versions


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (with_executable_stack, "its stack is executable"),
        (replaced(b"libc.so.6", b"libz.so.1"), "it needs libz.so.1: link it statically"),
        (replaced(b"GLIBC_2.17", b"GLIBC_2.38"), "it needs GLIBC_2.38, newer than GLIBC_2.28"),
        (replaced(b"GLIBC_2.17", b"CXXABI_1.3"), "it needs the symbols CXXABI_1.3"),
        (lambda data: data[:18] + struct.pack("<H", 183) + data[20:], "it is for aarch64, not for x86_64"),
    ],
    ids=["stack", "library", "glibc", "libstdc++", "machine"],
)
def test_a_library_that_would_not_load_everywhere_is_not_packed(
    library: Path, tmp_path: Path, damage: Callable[[bytes], bytes], complaint: str
) -> None:
    damaged = tmp_path / LIBRARY
    damaged.write_bytes(damage(library.read_bytes()))

    with pytest.raises(BuildError, match=re.escape(complaint)):
        pack(damaged, "x86_64", tmp_path / "wheels")

    assert not list(tmp_path.glob("wheels/*"))


def test_code_that_is_relocated_at_loading_is_refused() -> None:
    asked = SharedLibrary(
        machine="x86_64", needed=(), versions=(), executable_stack=False, text_relocations=True
    )

    assert complaints(asked, "x86_64") == ["its code is relocated at loading: compile with -fPIC"]


@pytest.mark.parametrize("length", [0, 4, 63, 64, 200, 1000, 5000])
def test_what_is_cut_off_is_no_library(library: Path, length: int) -> None:
    with pytest.raises(ElfError):
        read_library(library.read_bytes()[:length])


def test_the_wheel_is_for_every_python_and_its_record_is_right(library: Path, tmp_path: Path) -> None:
    wheel = pack(library, MACHINE, tmp_path)

    with zipfile.ZipFile(wheel) as archive:
        held = {name: archive.read(name) for name in archive.namelist()}

    def line_of(data: bytes) -> str:
        digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).decode().rstrip("=")
        return f"sha256={digest},{len(data)}"

    (record,) = [name for name in held if name.endswith("/RECORD")]
    lines = dict(line.split(",", 1) for line in held[record].decode().splitlines())
    assert re.fullmatch(rf"rse_pf_native-[0-9][0-9a-z.]*-py3-none-manylinux_2_28_{MACHINE}\.whl", wheel.name)
    assert [name for name in held if name.endswith(".so")] == [f"rse_pf_native/{LIBRARY}"]
    assert held[f"rse_pf_native/{LIBRARY}"] == library.read_bytes()
    assert lines.pop(record) == ","
    assert lines == {name: line_of(data) for name, data in held.items() if name != record}


def test_the_same_library_gives_the_same_wheel(library: Path, tmp_path: Path) -> None:
    wheels = [pack(library, MACHINE, tmp_path / each) for each in ("a", "b")]

    assert wheels[0].read_bytes() == wheels[1].read_bytes()


def test_the_core_has_the_version_of_the_platform(repository: Path) -> None:
    platform_file, core_file = (
        (repository / name).read_text(encoding="utf-8")
        for name in ("pyproject.toml", "native/pyproject.toml")
    )
    version = re.compile(r'^version = "(.+)"$', re.M)

    assert version.findall(core_file) == version.findall(platform_file)
    assert re.findall(r'"rse-pf-native==([^;]+);', platform_file) == version.findall(platform_file)


def test_the_library_uses_what_the_processor_has(library: Path) -> None:
    has = set(Path("/proc/cpuinfo").read_text(encoding="ascii").split())
    widest = (
        "avx512" if {"avx512f", "avx512dq", "avx512vl"} <= has else "avx2" if "avx2" in has else "portable"
    )

    assert open_solver(library).lanes == widest


def test_without_a_compiler_for_the_machine_one_line_says_what_to_do(monkeypatch) -> None:
    monkeypatch.delenv("CXX", raising=False)
    other = {"x86_64": "aarch64"}.get(MACHINE, "x86_64")

    with pytest.raises(BuildError, match=f"no C\\+\\+ compiler for {other}") as told:
        compiled(other)

    assert "ziglang" in told.value.hint


def test_the_library_for_arm_may_be_shipped() -> None:
    if not AARCH64.is_file():
        pytest.skip("no library for aarch64: make assets builds it")

    assert complaints(read_library(AARCH64.read_bytes()), "aarch64") == []
