"""Follow the lifecycle of the instance in its group: drain when it leaves."""

from __future__ import annotations

from rse_pf.audit.log import SYNC_S
from rse_pf.aws.fleet.drain_hook import leave_group
from rse_pf.aws.fleet.task import ALWAYS, AgentContext, Phase, Task

__all__ = ["task"]


def task(context: AgentContext) -> Task:
    """Ask where the instance is to go, and drain it once when that is out of the group."""
    config, state = context.config, context.state

    def flush_last() -> None:
        context.sleep(2 * SYNC_S)  # a server that has ended was still writing
        state.flush()

    def follow() -> None:
        if not context.machine.is_leaving():
            return
        context.log("leaving", group=config.group)
        state.flush()  # most of the log is uploaded before time is short
        drained = leave_group(
            context.machine, context.clients["autoscaling"], group=config.group, hook=config.hook,
            settings=context.settings, clock=context.clock, sleep=context.sleep, before_end=flush_last,
        )  # fmt: skip
        state.phase = Phase.LEFT
        context.log("left", drained=drained)

    return Task(name="lifecycle", period_s=0.0, call=follow, phases=ALWAYS - {Phase.LEFT})
