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
"""That of this Python, or of the variable ``_PYTHON_HOST_PLATFORM`` where another one is compiled for."""


class BuildLibrary(build_py):
    """Put the compiled library beside the module by which it is found."""

    def run(self) -> None:
        """Compile what has changed, and copy the library; a checkout is only made known to pip."""
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


class OfOneMachine(Distribution):
    """A package that is not for every machine."""

    def has_ext_modules(self) -> bool:
        """Return True, so that the wheel is for one platform."""
        return True


class OfEveryPython(bdist_wheel):
    """A wheel whose library uses nothing of Python."""

    def get_tag(self) -> tuple[str, str, str]:
        """Return the tag of every Python 3 on this platform."""
        return "py3", "none", super().get_tag()[2]


setup(distclass=OfOneMachine, cmdclass={"build_py": BuildLibrary, "bdist_wheel": OfEveryPython})
