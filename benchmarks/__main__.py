"""``python -m benchmarks``: the command line of all benchmarks."""

from __future__ import annotations

import sys

from benchmarks.frame.registry import run

if __name__ == "__main__":
    sys.exit(run(sys.argv[1:]))
