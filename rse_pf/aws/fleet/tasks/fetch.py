"""Copy an object of the artifact bucket to a file of the server, if it changed and is valid."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from rse_pf.aws.fleet.task import AgentContext
from rse_pf.errors import NotFound
from rse_pf.storage.files import replace_file

__all__ = ["fetch"]


def fetch(context: AgentContext, name: str, file: Path, check: Callable[[bytes], object]) -> bool:
    """Write the object *name* to *file* if the two differ; return whether the object exists.

    Raises:
        RsePfError: The store does not answer, or *check* raised this error for the object's bytes; then the
            file stays as it was.
    """
    try:
        fresh = context.artifacts.get(name)
    except NotFound:
        return False
    if not file.exists() or file.read_bytes() != fresh:
        check(fresh)
        file.parent.mkdir(exist_ok=True)
        replace_file(file, fresh)
        context.log("fetched", name=name, bytes=len(fresh))
    return True
