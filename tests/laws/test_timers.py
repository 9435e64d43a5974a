"""The law of timers: what a connection starts ends with it.

A timer holds what it will call, and all that that refers to: a connection that is gone, messages that wait.
So the handle of every timer is kept where something cancels it.  Only timers of objects that live as long as
their process may be forgotten, and these hold nothing but that object.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping

import pytest

COVERED = (
    "rse_pf/backend/",
    "rse_pf/data_server/",
    "rse_pf/fleet_page/",
    "rse_pf/local/control/",
    "lambda_pnp/",
)
STARTS = {"call_later", "call_at"}
LIVE_AS_LONG_AS_THE_PROCESS = {
    "rse_pf/backend/compute/lane.py": {"ComputeLane"},
    "rse_pf/backend/gateway/audit_recorder.py": {"AuditRecorder"},
    "rse_pf/backend/gateway/dispatcher.py": {"Dispatcher"},
    "rse_pf/backend/gateway/stateless_queue.py": {"StatelessQueue"},
    "rse_pf/backend/gateway/migration.py": {"Migration"},
    "rse_pf/backend/live_map/subscriptions.py": {"Subscriptions"},
    "rse_pf/backend/rosbridge/peers.py": {"WorkerPeers", "_Peers"},
    "rse_pf/backend/rosbridge/topics.py": {"RosbridgeTopics"},
    "rse_pf/backend/supervisor/robot_events.py": {"RobotEvents"},
    "rse_pf/backend/supervisor/worker.py": {"_Worker"},
}
PLAIN = {"within_ms"}
"""Arguments that are numbers."""


def broken(path: str, source: str) -> Iterator[str]:
    """Yield what breaks the law in *source*."""
    tree = ast.parse(source)
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    cancels = any(_is_call(node, {"cancel"}) for node in ast.walk(tree))
    for node in ast.walk(tree):
        is_kept = isinstance(node, ast.Assign | ast.AnnAssign) and cancels
        if not isinstance(node, ast.Assign | ast.AnnAssign | ast.Expr) or is_kept:
            continue
        if not _is_call(node.value, STARTS):
            continue
        assert isinstance(node.value, ast.Call)
        _, callback, *arguments = node.value.args
        owners = {each.name for each in classes if each.lineno <= node.lineno <= (each.end_lineno or 0)}
        if not owners & LIVE_AS_LONG_AS_THE_PROCESS.get(path, set()):
            yield f"line {node.lineno}: nothing cancels this timer"
        elif not _holds_nothing(callback, arguments):
            yield f"line {node.lineno}: this timer holds more than its object, and nothing cancels it"


def _is_call(node: ast.AST | None, names: set[str]) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in names


def _holds_nothing(callback: ast.expr, arguments: list[ast.expr]) -> bool:
    if (
        isinstance(callback, ast.Call)
        and isinstance(callback.func, ast.Name)
        and callback.func.id == "partial"
    ):
        callback, *bound = callback.args
        arguments = [*bound, *arguments]
    is_method = isinstance(callback, ast.Attribute) and ast.unparse(callback.value) == "self"
    return is_method and all(isinstance(each, ast.Name) and each.id in PLAIN for each in arguments)


def test_every_timer_is_kept_where_something_cancels_it(sources: Mapping[str, str]) -> None:
    found = {path: list(broken(path, text)) for path, text in sources.items() if path.startswith(COVERED)}

    assert {path: told for path, told in found.items() if told} == {}


def test_every_exception_is_needed(sources: Mapping[str, str]) -> None:
    for path in LIVE_AS_LONG_AS_THE_PROCESS:
        assert any(f".{name}(" in sources[path] for name in STARTS), path


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("rse_pf/backend/rosbridge/topics.py", "self.loop.call_later(wait_s, self.rested, subscription)"),
        ("rse_pf/backend/rosbridge/topics.py", "self.loop.call_later(1, partial(self.rested, client))"),
        ("rse_pf/backend/rosbridge/topics.py", "self.loop.call_later(1, lambda: self.rested(client))"),
        ("rse_pf/backend/rosbridge/topics.py", "self.timer = self.loop.call_later(1, self.rested, client)"),
        ("rse_pf/backend/gateway/websocket.py", "loop.call_later(2, self.transport.disconnect, False)"),
        ("rse_pf/data_server/app.py", "loop.call_at(2, self.end)"),
    ],
)
def test_the_law_of_timers_catches(path: str, body: str) -> None:
    assert list(broken(path, f"class RosbridgeTopics:\n    def f(self):\n        {body}\n"))


def test_the_law_of_timers_allows_what_its_object_outlives_and_what_is_cancelled() -> None:
    lived = "class RosbridgeTopics:\n    def f(self):\n        self.loop.call_later(1, self.retry)\n"
    kept = "class A:\n    def f(self):\n        self.t = loop.call_later(1, self.g, x)\n"
    kept += "    def e(self):\n        self.t.cancel()\n"

    assert list(broken("rse_pf/backend/rosbridge/topics.py", lived)) == []
    assert list(broken("rse_pf/data_server/app.py", kept)) == []
