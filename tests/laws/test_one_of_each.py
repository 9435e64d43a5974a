"""One idea has one place: queues of commands, leases, servers and clients of control ports."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

BACKEND = "rse_pf/backend"
CONTROL_SERVER = "rse_pf/control_http.py"
CONTROL_CLIENT = "rse_pf/local/servers/control_client.py"
LEASE = "rse_pf/lease.py"
PROTOCOL = "CommandQueue"


def queues(tree: Mapping[str, str]) -> Iterator[tuple[str, set[str], set[str]]]:
    """Yield the name, the bases and the methods of each class that takes a `QueuedCommand` with `submit`."""
    for path, text in tree.items():
        for node in ast.walk(ast.parse(text)):
            if not isinstance(node, ast.ClassDef):
                continue
            methods = {each.name: each for each in node.body if isinstance(each, ast.FunctionDef)}
            takes = [ast.unparse(each.annotation or each) for each in _arguments(methods.get("submit"))]
            if "QueuedCommand" in takes:
                yield f"{path}: {node.name}", {ast.unparse(base) for base in node.bases}, set(methods)


def _arguments(function: ast.FunctionDef | None) -> list[ast.arg]:
    return [] if function is None else function.args.args[1:]


def sources(repository: Path) -> dict[str, str]:
    """Return the modules of the backend server, by their paths."""
    return {
        path.relative_to(repository).as_posix(): path.read_text(encoding="utf-8")
        for path in sorted((repository / BACKEND).rglob("*.py"))
    }


INSIDE = {
    "rse_pf/backend/scheduling/command_queue.py: CommandQueue",
    "rse_pf/backend/scheduling/scheduler.py: Scheduler",
    "rse_pf/backend/sandbox/manager.py: SandboxManager",
}
"""The protocol itself, and what two queues are made of; a dispatcher never sees these."""


def beside_the_protocol(tree: Mapping[str, str]) -> set[str]:
    """Return the classes of *tree* in which commands wait and which are no `CommandQueue`."""
    return {name for name, bases, _ in queues(tree) if PROTOCOL not in bases} - INSIDE


def test_commands_wait_in_queues_of_one_protocol(repository: Path) -> None:
    tree = sources(repository)

    assert beside_the_protocol(tree) == set()
    assert len([name for name, bases, _ in queues(tree) if PROTOCOL in bases]) >= 5


def test_the_dispatcher_knows_its_queues_by_the_protocol_alone(repository: Path) -> None:
    text = (repository / BACKEND / "gateway" / "dispatcher.py").read_text(encoding="utf-8")
    known = {alias.name for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)
             for alias in node.names}  # fmt: skip
    classes = {name.rpartition(" ")[2] for name, bases, _ in queues(sources(repository)) if PROTOCOL in bases}

    # It tries the queue of the shortest way first, and live maps take subscriptions, which are no commands.
    assert known & classes == {"StatelessQueue", "LiveMapRouter"}


def test_a_second_kind_of_queue_is_caught() -> None:
    text = "class Waiting:\n    def submit(self, queued: QueuedCommand) -> None: ..."

    assert beside_the_protocol({"x.py": text}) == {"x.py: Waiting"}
    assert beside_the_protocol({"x.py": text.replace("Waiting", "Waiting(CommandQueue)")}) == set()


def product(repository: Path) -> dict[str, str]:
    """Return the modules of the product, by their paths."""
    return {
        path.relative_to(repository).as_posix(): path.read_text(encoding="utf-8")
        for path in sorted((repository / "rse_pf").rglob("*.py"))
    }


def with_own_http(tree: Mapping[str, str], opener: str) -> set[str]:
    """Return the modules of *tree* that call *opener* of asyncio and write or read HTTP themselves."""
    return {path for path, text in tree.items() if f"asyncio.{opener}(" in text and "HTTP/1.1" in text}


def with_own_lease(tree: Mapping[str, str]) -> set[str]:
    """Return the modules of *tree* that count renewals, and swap the record themselves."""
    return {path for path, text in tree.items() if "compare_and_swap(" in text and "beat" in text}


def test_there_is_one_server_of_control_ports_and_one_client(repository: Path) -> None:
    tree = product(repository)

    assert with_own_http(tree, "start_server") == {CONTROL_SERVER}
    assert with_own_http(tree, "open_connection") == {CONTROL_CLIENT}


def test_there_is_one_lease(repository: Path) -> None:
    assert with_own_lease(product(repository)) == {LEASE}


def test_a_second_server_client_or_lease_is_caught() -> None:
    server = "server = await asyncio.start_server(talk)\nwriter.write(b'HTTP/1.1 200 OK')"
    lease = "store.compare_and_swap(name, known, encode(replace(record, beat=record.beat + 1)))"

    assert with_own_http({"x.py": server}, "start_server") == {"x.py"}
    assert with_own_http({"x.py": server.replace("start_server", "open_connection")}, "open_connection")
    assert with_own_lease({"x.py": lease}) == {"x.py"}
