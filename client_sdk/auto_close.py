"""Let a ``with`` block call the method ``close`` of an object at its end."""

from __future__ import annotations

from types import TracebackType
from typing import TypeVar

__all__ = ["AutoClose"]

_Self = TypeVar("_Self", bound="AutoClose")


class AutoClose:
    """Give a class with a ``close`` method the ``with`` statement, which closes it also after an error."""

    __slots__ = ()

    def close(self) -> None:
        """Release files, threads or connections; may be called twice."""
        raise NotImplementedError

    def __enter__(self: _Self) -> _Self:
        """Return this object."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close this object."""
        self.close()
