"""One idea has one place: queues of commands, leases, control ports, starts of processes, and load."""

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


CHILDREN = {"rse_pf/child/start.py"}
"""Starts the processes that work for another one."""
FORKS = {
    "rse_pf/backend/supervisor/worker_handle.py": "workers share what the supervisor has imported",
    "rse_pf/child/limited.py": "the fork server of killable computations",
    "rse_pf/backend/sandbox/zygote.py": "the fork server of sandboxes",
    "rse_pf/backend/sandbox/isolation.py": "a child tries a means of isolation, and is gone",
}
SERVERS = {
    "rse_pf/local/processes.py": "servers have a log, and may outlive the control plane that started them",
    "rse_pf/local/faults/network_emulator.py": "the emulator is beside what it disturbs",
    "rse_pf/cli/local_platform/page.py": "the fleet page is a server beside the platform",
    "rse_pf/experiments/child_process.py": "robots of experiments",
    "rse_pf/experiments/paper/control_plane_fault.py": "a platform that is killed",
}
PROGRAMS = {
    "rse_pf/aws/fleet/journal.py": "journalctl",
    "rse_pf/aws/lifecycle/cdk_tools.py": "cdk",
    "rse_pf/services/custom/dependencies.py": "pip",
    "rse_pf/cli/services/debugging.py": "a debugger",
    "rse_pf/cli/services/building.py": "a compiler",
    "rse_pf/cli/doctor.py": "versions of programs",
    "rse_pf/cli/cloud/doctor.py": "versions of programs",
    "rse_pf/experiments/compare/evo_figures.py": "evo",
    "rse_pf/experiments/results/result_folder.py": "git",
    "rse_pf/local/faults/faults.py": "a helper that holds the rights for a fault",
}
"""Programs of others, which run to their end."""
STARTS = {
    "subprocess.Popen", "subprocess.run", "subprocess.call", "subprocess.check_output", "os.fork",
    "os.forkpty", "os.posix_spawn", "os.posix_spawnp", "os.system", "os.popen", "multiprocessing.Process",
    "multiprocessing.Pool", "multiprocessing.get_context", "asyncio.create_subprocess_exec",
    "asyncio.create_subprocess_shell", "ProcessPoolExecutor", "futures.ProcessPoolExecutor",
}  # fmt: skip


def starters(tree: Mapping[str, str]) -> set[str]:
    """Return the modules of *tree* that start a process."""
    return {
        path
        for path, text in tree.items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call) and ast.unparse(node.func) in STARTS
    }


def test_child_processes_are_started_in_one_place(repository: Path) -> None:
    known = CHILDREN | FORKS.keys() | SERVERS.keys() | PROGRAMS.keys()

    assert starters(product(repository)) == known


def test_another_start_of_a_process_is_caught() -> None:
    for start in ("subprocess.Popen([sys.executable])", "os.fork()", "multiprocessing.get_context('spawn')"):
        assert starters({"x.py": f"child = {start}"}) == {"x.py"}
    assert starters({"x.py": "child = start_child(plan)"}) == set()


GENERATORS = {"rse_pf/experiments/load/swarm_process.py", "benchmarks/server/load.c"}
"""Both load generators: that of users, by the real SDK, and that of benchmarks."""
PACED = {
    "benchmarks/cloud/burst.py": "the burst function of the SDK decides when frames go elsewhere",
    "benchmarks/cloud/delaying_proxy.py": "no robot, but the delay of a link",
    "benchmarks/cloud/network_gone.py": "the SDK reconnects; a robot asks what it sees",
    "benchmarks/cloud/outage.py": "the SDK reconnects; a robot asks what it sees",
    "benchmarks/cloud/regions.py": "one robot with two regions",
    "benchmarks/cloud/s3_outage.py": "robots of the SDK that store and ask, one after another",
    "benchmarks/cloud/services.py": "calls of a service while it is replaced",
    "benchmarks/data/floods.py": "HTTP to the data service",
    "benchmarks/data/requests.py": "HTTP to the data service",
    "benchmarks/hostile/connections.py": "one robot beside silent connections",
    "benchmarks/hostile/deadlines.py": "robots of a service of their own, with deadlines of their own",
    "benchmarks/hostile/maps.py": "the attacker",
    "benchmarks/hostile/one_tenant.py": "the neighbour drives, stores and asks",
    "benchmarks/hostile/photos.py": "HTTP to the data service",
    "benchmarks/hostile/robots.py": "waits for the end of a window",
    "benchmarks/hostile/sandboxes.py": "robots beside crashes, with services of their own",
    "benchmarks/live/hostile_rigs.py": "keyframes of a live map",
    "benchmarks/live/neighbours.py": "keyframes of a live map",
    "benchmarks/peers/orbslam3_process.py": "frames for another system",
    "benchmarks/server/sdk_overload.py": "the SDKs decide what is held back",
    "benchmarks/server/tails.py": "waits for the end of a window",
    "rse_pf/experiments/demo/robot.py": "the frames of one camera",
}
"""Modules that do something at a planned time and are no generator, with what they do then."""
PROGRAMS_OF_SDKS = {"benchmarks/server/sdk_robots.cpp", "benchmarks/server/sdk_robots.mjs"}
SCENARIO = "LoadScenario"
NO_LOAD = {
    "benchmarks/cloud/elasticity.py: run_benchmark": "gives both to the paper's experiment",
    "rse_pf/aws/money/costs.py: Load": "what a month of it costs",
    "rse_pf/experiments/demo/robot.py: DemoOptions": "robots that map with their cameras",
}
RATES = {"fps", "frames_per_s", "rate_hz", "per_s", "commands_per_s"}


def paced(tree: Mapping[str, str]) -> set[str]:
    """Return the modules of *tree* that sleep until a time that they have planned."""
    return {
        path
        for path, text in tree.items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("sleep")
        if any(isinstance(part, ast.Sub) for each in node.args for part in ast.walk(each))
    }


def scenarios(tree: Mapping[str, str]) -> set[str]:
    """Return what in *tree* takes a number of robots and their rate, and makes no `LoadScenario` of them."""
    return {
        f"{path}: {node.name}"
        for path, text in tree.items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        if "robots" in (names := _fields(node)) and names & RATES and SCENARIO not in text
    }


def _fields(node: ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    if isinstance(node, ast.ClassDef):
        return {ast.unparse(each.target) for each in node.body if isinstance(each, ast.AnnAssign)}
    return {each.arg for each in (*node.args.args, *node.args.kwonlyargs)}


def with_benchmarks(repository: Path) -> dict[str, str]:
    """Return the modules of the product and of its benchmarks, by their paths."""
    modules = sorted((repository / "benchmarks").rglob("*.py"))
    return product(repository) | {
        path.relative_to(repository).as_posix(): path.read_text(encoding="utf-8") for path in modules
    }


def test_load_comes_from_two_generators(repository: Path) -> None:
    modules = {path: text for path, text in with_benchmarks(repository).items()
               if path.startswith(("benchmarks/", "rse_pf/experiments/"))}  # fmt: skip
    programs = {
        path.relative_to(repository).as_posix()
        for path in (repository / "benchmarks").rglob("*")
        if path.is_file() and path.suffix not in (".py", ".pyc", ".md")
    }

    assert paced(modules) | programs == GENERATORS | PACED.keys() | PROGRAMS_OF_SDKS


def test_load_is_described_by_one_scenario(repository: Path) -> None:
    tree = with_benchmarks(repository)

    assert scenarios(tree) == NO_LOAD.keys()
    assert [path for path, text in tree.items() if f"class {SCENARIO}" in text] == [
        "rse_pf/experiments/load/scenario.py"
    ]


def test_a_third_generator_and_a_second_scenario_are_caught() -> None:
    third = "await asyncio.sleep(max(0.0, due - loop.time()))\nrobot.post(1)"
    second = "class Load:\n    robots: int = 10\n    fps: float = 5.0"

    assert paced({"x.py": third}) == {"x.py"}
    assert paced({"x.py": "await asyncio.sleep(PAUSE_S)"}) == set()
    assert scenarios({"x.py": second}) == {"x.py: Load"}
    assert scenarios({"x.py": "async def run(robots: int, *, per_s: float) -> None: ..."}) == {"x.py: run"}
    assert scenarios({"x.py": f"{second}\nscenario = LoadScenario(robots=3)"}) == set()
