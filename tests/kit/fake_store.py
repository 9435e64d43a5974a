"""An object store in memory whose operations tests observe, delay or let fail."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

from rse_pf.storage.object_store import MemoryStore, ObjectInfo

Hook = Callable[[str, str, bytes], None]
"""A function of an operation (the name of a method), the name of the object, and the written data."""


def do_nothing(operation: str, name: str, data: bytes) -> None:
    """Let an operation pass."""


class FakeStore(MemoryStore):
    """A store that calls *before* each operation and *after* each write; an error that they raise is its own.

    `calls` counts the operations by their names.
    """

    def __init__(self, before: Hook = do_nothing, after: Hook = do_nothing) -> None:
        super().__init__()
        self.before, self.after = before, after
        self.calls: Counter[str] = Counter()

    def _begin(self, operation: str, name: str, data: bytes = b"") -> None:
        self.calls[operation] += 1
        self.before(operation, name, data)

    def get(self, name: str) -> bytes:
        self._begin("get", name)
        return super().get(name)

    def get_range(self, name: str, start: int, length: int) -> bytes:
        self._begin("get_range", name)
        return super().get(name)[start : start + length]

    def head(self, name: str) -> ObjectInfo:
        self._begin("head", name)
        return ObjectInfo(name=name, size=len(super().get(name)))

    def list(self, prefix: str = "", after: str = "") -> Iterator[ObjectInfo]:
        self._begin("list", prefix)
        return super().list(prefix, after)

    def put(self, name: str, data: bytes) -> None:
        self._begin("put", name, data)
        super().put(name, data)
        self.after("put", name, data)

    def delete(self, name: str) -> None:
        self._begin("delete", name)
        super().delete(name)
        self.after("delete", name, b"")

    def compare_and_swap(self, name: str, expected: bytes | None, data: bytes) -> None:
        self._begin("compare_and_swap", name, data)
        super().compare_and_swap(name, expected, data)
        self.after("compare_and_swap", name, data)


def fail_with(error: Exception, *operations: str, part: str = "") -> Hook:
    """Return a hook that raises *error* in *operations* on objects whose names contain *part*."""

    def refuse(operation: str, name: str, data: bytes) -> None:
        if operation in operations and part in name:
            raise error

    return refuse
