"""Build one wheel: ``python -m native.wheel_builder --into DIR [--machine aarch64 --compiler '... c++']``."""

from __future__ import annotations

import argparse
import platform
import sys
from pathlib import Path

from .backend import BuildError, built_wheel


def main() -> int:
    """Build the wheel and print its path, or say in two lines why there is none."""
    parser = argparse.ArgumentParser(description="Build the wheel rse-pf-native.")
    parser.add_argument("--into", type=Path, required=True, metavar="DIR")
    parser.add_argument("--machine", default=platform.machine(), choices=("x86_64", "aarch64"))
    parser.add_argument("--compiler", help="of C++20, for that machine (default: $CXX, c++, g++ or clang++)")
    args = parser.parse_args()
    try:
        wheel = built_wheel(args.into, args.machine, args.compiler)
    except BuildError as error:
        sys.stderr.write(f"native: {error}\n  hint: {error.hint}\n")
        return 2
    sys.stdout.write(f"{wheel}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
