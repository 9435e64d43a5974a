"""Drain the server when AWS announces that it takes the Spot instance back.

The notice comes two minutes before the interruption: the robots move within seconds, and the machine is idle
until AWS takes it.  A recommendation to rebalance may come earlier, for all instances of a pool at once, and
is only logged: the group starts a replacement (`stacks.capacity`), and then removes this instance, whose
drain hook moves the robots.
"""

from __future__ import annotations

from rse_pf.aws.fleet.drain_hook import drain_server
from rse_pf.aws.fleet.instance import INTERRUPTION
from rse_pf.aws.fleet.task import AgentContext, Phase, Task

__all__ = ["LOOK_EVERY_S", "task"]

# Time between two reads of the notice, in seconds: a drain begins less than 5 s after the notice.
LOOK_EVERY_S = 2.0


def task(context: AgentContext) -> Task:
    """Return the task that reads the notice every two seconds if ``cloud.spot`` is set, and drains once."""
    is_spot = context.settings.cloud.spot
    last = ""

    def follow() -> None:
        nonlocal last
        if not is_spot:
            return
        notice = context.machine.spot_notice()
        if notice and notice != last:
            context.log("spot-notice", notice=notice)
        last = notice
        if notice != INTERRUPTION:
            return
        context.state.phase = Phase.LEAVING
        context.state.flush()
        drained = drain_server(
            context.machine, settings=context.settings, clock=context.clock, sleep=context.sleep
        )
        context.state.flush()
        context.log("drained", drained=drained)

    return Task(name="spot-notice", period_s=LOOK_EVERY_S, call=follow, phases=frozenset({Phase.SERVING}))
