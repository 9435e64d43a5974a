"""Let operations of a directory store fail at random, in every process of a platform: for experiments.

The processes of a platform start each other, and all of them inherit the environment.  `failing_environment`
makes Python load a ``sitecustomize`` in each of them; that lets a share of the operations on `DirectoryStore`
raise StoreError.  The share stands in a file, so that it can change while the platform runs.  Half of the
writes that fail have taken place before: an answer that was lost looks like a failure, too.

Nothing here is loaded by a platform that was started without this environment.
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

_VARIABLE = "RSE_PF_FAILING_STORE"
_SHARE = "percent"
_READS = ("get", "head")
_WRITES = ("put", "put_pieces", "compare_and_swap", "delete")
_SITE = "from rse_pf.extensions.experiments.faults.failing_store import install\n\ninstall()\n"


@contextlib.contextmanager
def failing_environment(folder: Path) -> Iterator[None]:
    """Let every Python process that is started inside the block follow `set_failing_percent` of *folder*."""
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
    """Let *percent* of the operations fail from now on, in all processes that follow *folder*."""
    replace_file(folder / _SHARE, f"{percent:g}")


def install() -> None:
    """Change `DirectoryStore` in this process, if its environment says so."""
    place = os.environ.get(_VARIABLE)
    if not place:
        return
    share = Path(place) / _SHARE
    choice = random.Random(os.getpid())
    for name in _READS + _WRITES:
        original = getattr(DirectoryStore, name)
        setattr(DirectoryStore, name, _make_failing(original, share, choice, is_write=name in _WRITES))


def _make_failing(
    original: Callable[..., Any], share: Path, choice: random.Random, *, is_write: bool
) -> Callable[..., Any]:
    @functools.wraps(original)
    def operation(store: DirectoryStore, name: str, *rest: Any, **named: Any) -> Any:
        drawn = choice.uniform(0.0, 100.0)
        percent = _read(share)
        if drawn >= percent:
            return original(store, name, *rest, **named)
        if is_write and drawn < percent / 2:
            original(store, name, *rest, **named)
        raise StoreError(f"{name!r}: the store fails by order", hint="this is an experiment")

    return operation


def _read(share: Path) -> float:
    try:
        return float(share.read_text(encoding="utf-8") or 0.0)
    except (OSError, ValueError):
        return 0.0
