"""The packages of the cloud hold the native core; `make slow` builds them first."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
import zipfile
from pathlib import Path

import pytest

from rse_pf.native import open_solver

pytestmark = pytest.mark.slow

LIBRARY = "librse_pf_native.so"
_MACHINE_AT, _AARCH64 = 18, 183
"""Where an ELF file names its machine, and the number of ARM with 64 bits."""


@pytest.fixture
def build(repository: Path) -> Path:
    """The folder of the packages."""
    folder = repository / "build"
    if not (folder / "assets.sha256").is_file():
        pytest.skip("no packages: run make assets")
    return folder


def test_a_server_installs_the_core_by_its_hash(build: Path) -> None:
    (wheel,) = (build / "wheelhouse").glob("rse_pf_native-*.whl")
    version = wheel.name.split("-")[1]

    lines = (build / "wheelhouse" / "requirements.txt").read_text(encoding="utf-8").splitlines()

    digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
    assert f"rse_pf_native=={version} --hash=sha256:{digest}" in lines


def test_the_function_and_the_servers_have_the_same_core_and_it_loads(build: Path) -> None:
    (wheel,) = (build / "wheelhouse").glob("rse_pf_native-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        of_servers = archive.read(f"rse_pf_native/{LIBRARY}")
    of_the_function = build / "lambda" / "rse_pf_native" / LIBRARY

    assert of_the_function.read_bytes() == of_servers
    assert (build / "lambda" / "rse_pf_native" / "__init__.py").is_file()
    assert "manylinux_2_28_x86_64" in wheel.name, "auditwheel did not look at its symbols"
    assert open_solver(of_the_function).lanes in ("avx512", "avx2", "portable")


def test_the_wheel_for_arm_holds_a_library_for_arm(build: Path) -> None:
    wheels = list((build / "native").glob("*aarch64.whl"))
    if not wheels:
        pytest.skip("no wheel for aarch64: run make assets")
    with zipfile.ZipFile(wheels[0]) as archive:
        data = archive.read(f"rse_pf_native/{LIBRARY}")

    digest = hashlib.sha256(wheels[0].read_bytes()).hexdigest()
    assert "-manylinux_2_" in wheels[0].name, "auditwheel did not look at its symbols"
    assert int.from_bytes(data[_MACHINE_AT : _MACHINE_AT + 2], "little") == _AARCH64
    assert digest in (build / "native" / "requirements.txt").read_text(encoding="utf-8")


@pytest.mark.timeout(900)  # with an empty cache the compiler builds its own C++ library first
def test_the_compiler_for_arm_builds_a_core_with_the_instructions_of_the_processor(
    build: Path, repository: Path, tmp_path: Path
) -> None:
    zig = build / "ziglang" / "ziglang" / "zig"
    if not zig.is_file() or platform.machine() != "x86_64":
        pytest.skip("no compiler of the wheel ziglang: run make assets on x86-64")
    command = ["make", "-j2", "-C", str(repository / "native"), f"OUT={tmp_path}", "ARCH=x86_64"]
    cache = str((build / "zig-cache").resolve())  # that of `make assets`
    caches = {"ZIG_GLOBAL_CACHE_DIR": cache, "ZIG_LOCAL_CACHE_DIR": cache}
    subprocess.run(
        [*command, f"CXX={zig} c++ -target x86_64-linux-gnu.2.28"], check=True, env=os.environ | caches
    )

    has = set(Path("/proc/cpuinfo").read_text(encoding="ascii").split())
    widest = (
        "avx512" if {"avx512f", "avx512dq", "avx512vl"} <= has else "avx2" if "avx2" in has else "portable"
    )
    assert open_solver(tmp_path / LIBRARY).lanes == widest
