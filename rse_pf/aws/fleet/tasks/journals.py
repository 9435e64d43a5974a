"""Upload the machine's journals to the artifact bucket, from where ``rse-pf cloud logs`` shows them.

Otherwise the journals would be lost with the machine.  S3 is reached by the free gateway endpoint, so that
this costs one object a minute; CloudWatch Logs would cost an interface endpoint in each zone.
"""

from __future__ import annotations

from rse_pf.aws.fleet.journal import make_batch
from rse_pf.aws.fleet.task import AgentContext, Task
from rse_pf.config.resource_names import JOURNAL_PREFIX
from rse_pf.storage.files import replace_file

__all__ = ["JOURNAL_SHIP_S", "piece_name", "task"]

# Time between two uploads, in seconds: a machine that fails loses the lines of at most a minute.
JOURNAL_SHIP_S = 60.0
_CURSOR_FILE = "journal.cursor"  # file in the state folder with the cursor of the last uploaded entry
# Most pieces that one call uploads, because it blocks the other tasks; later calls upload the rest.
_MAX_PIECES_PER_CALL = 8


def task(context: AgentContext) -> Task:
    """Return the task that uploads new lines of the journals once a minute, and before and after a drain."""
    return Task(
        name="journals", period_s=JOURNAL_SHIP_S, call=lambda: _ship(context),
        flushes=True,
    )  # fmt: skip


def piece_name(instance: str, first_us: int) -> str:
    """Return the object name of a piece whose first line is of *first_us* (Unix µs); names sort by time."""
    return f"{JOURNAL_PREFIX}/{instance}/{first_us:020d}.log"


def _ship(context: AgentContext) -> None:
    if context.journal is None:
        return
    file = context.config.state_folder / _CURSOR_FILE
    for _ in range(_MAX_PIECES_PER_CALL):
        cursor = file.read_text(encoding="utf-8") if file.exists() else ""
        batch = make_batch(context.journal(cursor))
        if batch is None:
            return
        # If the cursor is lost after this write, the same lines are written again under the same name.
        context.artifacts.put(piece_name(context.machine.instance_id(), batch.first_us), batch.text)
        replace_file(file, batch.cursor.encode())
