"""Follow the instance's lifecycle in its group: join when ready, wait in the warm pool, drain before removal.

Auto Scaling publishes the target state of an instance in the instance's metadata.  The agent completes the
launch hook for each target state, because a warmed instance that is used later waits for the hook again.
"""

from __future__ import annotations

from rse_pf.audit.log import SYNC_S
from rse_pf.aws.fleet.drain_hook import drain_server
from rse_pf.aws.fleet.instance import IN_SERVICE, TERMINATED, WARMED
from rse_pf.aws.fleet.launch_hook import LaunchAction, complete_hook, launch_action
from rse_pf.aws.fleet.task import ALWAYS, AgentContext, Phase, Task
from rse_pf.scaling.boot_time import ready_within_s

__all__ = ["task"]

_POLL_S = 5.0
"""Time between two reads of the target state, in seconds: the longest delay of a launch or a drain by it."""


def task(context: AgentContext) -> Task:
    """Return the task that reads the target state, and joins or leaves the group when it has changed."""
    return Task(
        name="lifecycle",
        period_s=_POLL_S,
        call=_Lifecycle(context).follow,
        phases=ALWAYS - {Phase.LEFT},
    )


class _Lifecycle:
    """The progress of the instance: the target state that it has joined, and whether its server drained.

    ``_drained`` is None before the drain, then whether the server exited in time.
    """

    def __init__(self, context: AgentContext) -> None:
        self._context = context
        self._joined = ""
        self._began_s: float | None = None
        self._drained: bool | None = None

    def follow(self) -> None:
        target = self._context.machine.target_state()
        if target == TERMINATED:
            self._leave_group()
        elif target != self._joined and (target == IN_SERVICE or target.startswith(WARMED)):
            self._join(target)

    def _join(self, target: str) -> None:
        """Complete the launch hook with CONTINUE if the server is ready, with ABANDON after `ready_within_s`.

        Before that time, a call with a server that is not ready does nothing.  After CONTINUE, or if the hook
        did not wait for this instance, the phase is SERVING, or WARMED in the warm pool.
        """
        context, state = self._context, self._context.state
        if state.phase is Phase.WARMED:
            state.phase = Phase.STARTING
        if self._began_s is None:
            self._began_s = context.clock()
        age_s = context.clock() - self._began_s
        action = launch_action(is_ready=context.machine.is_ready(), age_s=age_s, budget_s=ready_within_s())
        if action is LaunchAction.WAIT:
            return
        did_wait = self._complete(context.config.launch_hook, action.value)
        self._joined, self._began_s = target, None
        if action is LaunchAction.CONTINUE or not did_wait:
            state.phase = Phase.WARMED if target.startswith(WARMED) else Phase.SERVING
        event = "joined" if action is LaunchAction.CONTINUE else "not-ready"
        context.log(event, target=target, after_s=round(age_s, 1), hook=did_wait)

    def _leave_group(self) -> None:
        """Drain the server, then complete the termination hook.

        The first call drains, and blocks until the server has exited or the time for that is over.  If the
        hook does not wait for this instance yet, the next call tries to complete it again.
        """
        context = self._context
        context.state.phase = Phase.LEAVING
        if self._drained is None:
            context.log("leaving", group=context.config.group)
            context.state.flush()  # upload most of the logs before the drain, which has a time limit
            self._drained = drain_server(
                context.machine, settings=context.settings, clock=context.clock, sleep=context.sleep
            )
            context.sleep(2 * SYNC_S)  # the last audit entries of a server are on the disk after this time
            context.state.flush()
        if self._complete(context.config.hook, LaunchAction.CONTINUE.value):
            context.state.phase = Phase.LEFT
            context.log("left", drained=self._drained)

    def _complete(self, hook: str, result: str) -> bool:
        return bool(hook) and complete_hook(
            self._context.clients["autoscaling"], group=self._context.config.group, hook=hook,
            instance=self._context.machine.instance_id(), result=result,
        )  # fmt: skip
