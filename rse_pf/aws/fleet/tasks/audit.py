"""Upload the audit logs of this machine's servers to the audit bucket."""

from __future__ import annotations

from rse_pf.aws.fleet.task import AgentContext, Task

__all__ = ["AUDIT_SHIP_S", "task"]

# Time between two uploads, in seconds: a machine that fails loses the entries of at most a minute.
AUDIT_SHIP_S = 60.0


def task(context: AgentContext) -> Task:
    """Return the task that uploads new entries once a minute, and also before and after a drain."""

    def ship() -> None:
        count = 0 if context.shipper is None else context.shipper.ship()
        if count:
            context.log("shipped", pieces=count)

    return Task(name="audit", period_s=AUDIT_SHIP_S, call=ship, flushes=True)
