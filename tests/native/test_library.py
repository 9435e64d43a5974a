"""The native core of this checkout: its version, and which instructions of the processor it uses."""

from __future__ import annotations

import re
from pathlib import Path

from rse_pf.native import native_solver


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
