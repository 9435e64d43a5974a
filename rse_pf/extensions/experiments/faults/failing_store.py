"""Let operations of a directory store fail at random, in every process of a platform, for experiments.

All processes of a platform inherit its environment.  `failing_environment` sets variables with which Python
loads a ``sitecustomize`` module in each of them; this module replaces the operations of `DirectoryStore` by
ones of which a percentage raises StoreError.  The percentage is read from a file before each operation, so
that it can change while the platform runs.  Half of the failing writes are carried out before the error is
raised, as when only the answer of a store is lost.

A platform that was started without these variables loads nothing of this module.
"""

from __future__ import annotations

import contextlib
import functools
import os
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rse_pf.errors import StoreError
from rse_pf.storage.files import replace_file
from rse_pf.storage.object_store import DirectoryStore

__all__ = ["failing_environment", "install", "set_failing_percent"]

# Environment variable with the folder of ``sitecustomize.py`` and of the file that holds the percentage.
_VARIABLE = "RSE_PF_FAILING_STORE"
# Name of the file with the percentage of operations that fail.
_PERCENT_FILE = "percent"
# Methods of `DirectoryStore` that read, and fail before they are carried out.
_READS = ("get", "head")
# Methods of `DirectoryStore` that write; half of the failing ones are carried out before.
_WRITES = ("put", "put_pieces", "compare_and_swap", "delete")
# Source text of ``sitecustomize.py``, which Python runs when an interpreter starts.
_SITE = "from rse_pf.extensions.experiments.faults.failing_store import install\n\ninstall()\n"


@contextlib.contextmanager
def failing_environment(folder: Path) -> Iterator[None]:
    """Let stores fail, as `set_failing_percent` says, in every Python process started inside the block.

    Creates *folder* with ``sitecustomize.py`` and a percentage of 0, and sets environment variables of this
    process, which are restored after the block.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sitecustomize.py").write_text(_SITE, encoding="utf-8")
    set_failing_percent(folder, 0.0)
    path = os.environ.get("PYTHONPATH", "")
    changed = {"PYTHONPATH": f"{folder}{os.pathsep if path else ''}{path}", _VARIABLE: str(folder)}
    before = {name: os.environ.get(name) for name in changed}
    os.environ.update(changed)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def set_failing_percent(folder: Path, percent: float) -> None:
    """Let *percent* of the operations fail from now on, in all processes whose environment names *folder*."""
    replace_file(folder / _PERCENT_FILE, f"{percent:g}")


def install() -> None:
    """Make the operations of `DirectoryStore` in this process fail at random, if its environment says so."""
    place = os.environ.get(_VARIABLE)
    if not place:
        return
    percent_file = Path(place) / _PERCENT_FILE
    choice = random.Random(os.getpid())
    for name in _READS + _WRITES:
        original = getattr(DirectoryStore, name)
        setattr(DirectoryStore, name, _make_failing(original, percent_file, choice, is_write=name in _WRITES))


def _make_failing(
    original: Callable[..., Any], percent_file: Path, choice: random.Random, *, is_write: bool
) -> Callable[..., Any]:
    @functools.wraps(original)
    def operation(store: DirectoryStore, name: str, *rest: Any, **named: Any) -> Any:
        drawn = choice.uniform(0.0, 100.0)
        percent = _read_percent(percent_file)
        if drawn >= percent:
            return original(store, name, *rest, **named)
        if is_write and drawn < percent / 2:
            original(store, name, *rest, **named)
        raise StoreError(f"{name!r}: the store fails on purpose", hint="this is an experiment with faults")

    return operation


def _read_percent(percent_file: Path) -> float:
    try:
        return float(percent_file.read_text(encoding="utf-8") or 0.0)
    except (OSError, ValueError):
        return 0.0
