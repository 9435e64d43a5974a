"""The native core: its version, its instructions, and where an editable installation finds it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from rse_pf.pnp.native_solver import native_solver


def test_the_core_has_the_version_of_the_platform(repository: Path) -> None:
    platform_file, core_file = (
        (repository / name).read_text(encoding="utf-8")
        for name in ("pyproject.toml", "native/pyproject.toml")
    )
    version = re.compile(r'^version = "(.+)"$', re.M)

    assert version.findall(core_file) == version.findall(platform_file)
    assert set(re.findall(r'"rse-pf-native==(.+)"', platform_file)) == set(version.findall(platform_file))


def test_the_library_uses_what_the_processor_has() -> None:
    has = set(Path("/proc/cpuinfo").read_text(encoding="ascii").split())
    widest = (
        "avx512" if {"avx512f", "avx512dq", "avx512vl"} <= has else "avx2" if "avx2" in has else "portable"
    )

    assert native_solver().lanes == widest


def test_an_editable_installation_brings_the_library_that_its_checkout_built(tmp_path: Path) -> None:
    library = tmp_path / "build" / "librse_pf_native.so"
    for file in (library, tmp_path / "rse_pf_native" / "__init__.py"):
        file.parent.mkdir()
        file.touch()

    found = subprocess.run(
        [sys.executable, "-c", "from rse_pf.native import find_library; print(find_library())"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)}, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip

    assert found.strip() == str(library)
