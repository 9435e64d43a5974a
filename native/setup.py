"""Compile the native core with the Makefile and pack it into a wheel for every Python of one machine."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

NATIVE = Path(__file__).resolve().parent
MACHINE = sysconfig.get_platform().removeprefix("linux-")
"""The machine to compile for: that of this Python, or the one that ``_PYTHON_HOST_PLATFORM`` names."""


class BuildLibrary(build_py):
    """Build the wheel with the compiled library next to the module `rse_pf_native`."""

    def run(self) -> None:
        """Compile with the Makefile and copy the library; an editable installation compiles nothing."""
        super().run()
        if self.editable_mode:
            return
        compilers = [os.environ.get("CXX", ""), *map(shutil.which, ("c++", "g++", "clang++"))]
        compiler = next(filter(None, compilers), None)
        if compiler is None:
            sys.exit("native: no C++ compiler was found\n  hint: install g++, or name one in CXX")
        out = NATIVE / "build" / ("" if platform.machine() == MACHINE else MACHINE)
        command = ["make", "-C", str(NATIVE), f"OUT={out}", f"ARCH={MACHINE}", f"CXX={compiler}"]
        if subprocess.run(command, check=False).returncode:
            sys.exit("native: the library does not compile\n  hint: g++ 11 and clang 14 are new enough")
        shutil.copy(out / "librse_pf_native.so", Path(self.build_lib) / "rse_pf_native")


class PlatformDistribution(Distribution):
    """A distribution with compiled code, whose wheel is for one platform."""

    def has_ext_modules(self) -> bool:
        """Return True, which makes the wheel specific to a platform."""
        return True


class AnyPythonWheel(bdist_wheel):
    """A wheel for every version of Python 3: its library does not use Python's C interface."""

    def get_tag(self) -> tuple[str, str, str]:
        """Return the wheel's tag: any Python 3, no Python ABI, this platform."""
        return "py3", "none", super().get_tag()[2]


setup(distclass=PlatformDistribution, cmdclass={"build_py": BuildLibrary, "bdist_wheel": AnyPythonWheel})
