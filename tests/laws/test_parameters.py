"""A function has at most six parameters; the longer ones are listed here, and the list only becomes shorter.

More parameters are a value without a name: an address, an identity, a camera, a budget.  ``self`` and ``cls``
do not count.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

MAX_PARAMETERS = 6
MAX_LONGER = 30
FOLDERS = ("rse_pf", "client_sdk", "lambda_pnp", "stacks", "ros_bridge", "benchmarks")

LONGER = frozenset({
    "client_sdk/bags/choose.py: choose_topics",
    "client_sdk/live/mapper.py: LiveMapper.__init__",
    "client_sdk/live/sender.py: KeyframeSender.__init__",
    "client_sdk/mapper.py: Mapper.__init__",
    "client_sdk/mapper.py: PoseSolver.solve_pnp",
    "client_sdk/network/connection.py: Connection.__init__",
    "client_sdk/network/dialling.py: DialError.__init__",
    "client_sdk/offloading/asking.py: Asking.__init__",
    "client_sdk/offloading/burst.py: Burst.__init__",
    "client_sdk/robot.py: Robot.__init__",
    "client_sdk/robot.py: Robot.call",
    "client_sdk/robot.py: Robot.live_map",
    "client_sdk/robot.py: Robot.mapper",
    "client_sdk/robot.py: Robot.solve_pnp",
    "rse_pf/auth/tokens.py: SigningKey.issue",
    "rse_pf/backend/supervisor/supervisor.py: serve",
    "rse_pf/config/validation.py: setting",
    "rse_pf/data_server/app.py: DataServer.__init__",
    "rse_pf/experiments/paper/harness.py: Harness.__init__",
    "rse_pf/slam/smoother.py: _normal_equations",
    "rse_pf/slam/smoother.py: smooth",
    "rse_pf/local/control/platform.py: LocalPlatform.__init__",
    "rse_pf/local/servers/data_servers.py: LocalDataServers.__init__",
    "rse_pf/native_matcher.py: MatchCore.matches",
    "rse_pf/service.py: dispatch",
    "rse_pf/slam/map_merge.py: _version",
    "rse_pf/services/pnp.py: make_request",
    "rse_pf/wire/client_session.py: ClientSession.submit",
    "stacks/backend_servers.py: BackendServers.__init__",
    "stacks/job_servers.py: JobServers.__init__",
})  # fmt: skip
"""Functions with more parameters, as ``path: name``; nothing is added here."""


def with_too_many(tree: Mapping[str, str]) -> set[str]:
    """Return the functions of *tree* with more than `MAX_PARAMETERS`, as ``path: name``."""
    return {
        f"{path}: {name}"
        for path, text in tree.items()
        for name, count in _functions(ast.parse(text), "")
        if count > MAX_PARAMETERS
    }


def _functions(parent: ast.AST, prefix: str) -> Iterator[tuple[str, int]]:
    """Yield the name of each function below *parent* and its number of parameters."""
    for node in ast.iter_child_nodes(parent):
        inner = prefix
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            inner = f"{prefix}{node.name}."
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            yield prefix + node.name, sum(argument.arg not in ("self", "cls") for argument in given)
        yield from _functions(node, inner)


def test_no_further_function_has_more_than_six_parameters(repository: Path) -> None:
    tree = {
        path.relative_to(repository).as_posix(): path.read_text(encoding="utf-8")
        for folder in FOLDERS
        for path in sorted((repository / folder).rglob("*.py"))
    }

    assert with_too_many(tree) - LONGER == set(), "give what belongs together a name of its own"
    assert LONGER - with_too_many(tree) == set(), "these are short enough: remove them from LONGER"


def test_at_most_30_functions_are_longer() -> None:
    assert len(LONGER) <= MAX_LONGER


def test_a_function_with_seven_parameters_is_caught() -> None:
    short = "class A:\n    def f(self, a, b, c, d, *, e, f): ..."
    long = short.replace("e, f)", "e, f, g)")

    assert with_too_many({"x.py": short}) == set()
    assert with_too_many({"x.py": long}) == {"x.py: A.f"}
