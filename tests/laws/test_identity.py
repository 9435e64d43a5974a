"""The identity law: what a server keeps of a robot is kept under its `RobotId`, never under its name alone.

Two tenants may have robots of one name.  The law reads the sources of everything that serves robots and
finds what knows a robot as text: a parameter, field or attribute ``robot`` that is a ``str``, a table of
robots with another key, and a name used as a key or as a part of a path.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SERVES = ("rse_pf/backend", "rse_pf/data_server", "lambda_pnp")
MEANT = {
    "rse_pf/backend/gateway/handshake.py: anonymous: str",
    "rse_pf/backend/sandbox/manager.py: the name in a path",  # finds state without an owner, to refuse it
    # An operator names a robot by tenant and name, whatever key it was enrolled with.
    "rse_pf/backend/sandbox/circuit_breaker.py: robot: str | None",
    "rse_pf/backend/sandbox/manager.py: robot: str | None",
    "rse_pf/backend/sandbox/reloading.py: robot: str | None",
    "rse_pf/backend/supervisor/orders.py: robot: str | None",
}
"""What is meant to know a robot as text."""
_KEYED = {"get", "setdefault", "pop"}


def broken(source: str) -> list[str]:
    """Return what breaks the law in *source*, one text for each place."""
    found: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.arg | ast.AnnAssign):
            target = node.arg if isinstance(node, ast.arg) else ast.unparse(node.target)
            written = ast.unparse(node.annotation) if node.annotation is not None else ""
            found += _annotated(target.rpartition(".")[2], written)
        elif isinstance(node, ast.Subscript) and _is_name(node.slice):
            found.append("the name as a key")
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in _KEYED:
            found += ["the name as a key"] * (bool(node.args) and _is_name(node.args[0]))
        elif isinstance(node, ast.JoinedStr):
            text = "".join(str(part.value) for part in node.values if isinstance(part, ast.Constant))
            named = any(isinstance(part, ast.FormattedValue) and _is_name(part.value) for part in node.values)
            found += ["the name in a path"] * (named and "/" in text)
    return found


def _annotated(target: str, written: str) -> list[str]:
    is_robot = target in ("robot", "anonymous", "robot_name")
    if is_robot and written in ("str", "str | None"):
        return [f"{target}: {written}"]
    is_table = "robot" in target and written.startswith(
        ("dict[", "Counter[", "set[", "OrderedDict[", "deque[")
    )
    if is_table and "[str" in written:
        return [f"{target}: {written}"]
    return []


def _is_name(node: ast.expr) -> bool:
    """Return whether *node* is ``robot.name``, also in a tuple of which the tenant is not a part."""
    if isinstance(node, ast.Tuple):
        texts = [ast.unparse(each) for each in node.elts]
        return any(map(_is_name, node.elts)) and not any(text.endswith(".tenant") for text in texts)
    return (
        isinstance(node, ast.Attribute) and node.attr == "name" and ast.unparse(node.value).endswith("robot")
    )


def test_no_server_knows_a_robot_by_its_name_alone():
    places = {
        f"{path.relative_to(ROOT)}: {what}"
        for folder in SERVES
        for path in (ROOT / folder).rglob("*.py")
        for what in broken(path.read_text(encoding="utf-8"))
    }

    assert places == MEANT


@pytest.mark.parametrize(
    "source",
    [
        "def waiting_of(self, robot: str) -> int: ...",
        "class Queued:\n    robot: str",
        "self._by_robot: dict[str, int] = {}",
        "self._robots: dict[tuple[str, str], int] = {}",
        "robots: Counter[str] = Counter()",
        "self._sandboxes[queued.robot.name] = 1",
        "self._sandboxes[robot.name, service] = 1",
        "self._locks.setdefault(claims.robot.name, lock)",
        "f'snapshots/{call.queued.robot.name}/{service}'",
    ],
)
def test_the_law_finds_each_way_to_forget_the_tenant(source: str):
    assert broken(source)


@pytest.mark.parametrize(
    "source",
    [
        "def waiting_of(self, robot: RobotId) -> int: ...",
        "self._by_robot: dict[RobotId, int] = {}",
        "self._entries[queued.robot, key] = 1",
        "denied[robot.tenant, robot.name] = 1",
        "f'jobs/{robot.folder}/{key}'",
        "f'robot {robot.name!r} is slow'",
    ],
)
def test_the_law_lets_identities_pass(source: str):
    assert not broken(source)
