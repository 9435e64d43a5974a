"""The packages for AWS contain the native core; `make slow` builds the packages first."""

from __future__ import annotations

import hashlib
import zipfile
from pathlib import Path

import pytest

from rse_pf.pnp.native_solver import open_solver

pytestmark = pytest.mark.slow

LIBRARY = "librse_pf_native.so"
_MACHINE_AT, _AARCH64 = 18, 183
"""Byte offset of the machine in an ELF header, and the number of 64-bit ARM."""


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
