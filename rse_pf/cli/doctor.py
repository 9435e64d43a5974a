"""Check what this machine needs to run the platform, and say how to fix what it lacks.

Each line is ok, warn or fail; a failure is something that rse-pf local or rse-pf demo requires.

example:
  rse-pf doctor
"""

from __future__ import annotations

import contextlib
import os
import platform
import re
import resource
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from rse_pf.command_line.extras import EXTRAS, VERBS_NEED, modules_of
from rse_pf.command_line.options import Action, NoOptions
from rse_pf.command_line.packages import Defect, find_defect
from rse_pf.config import PlatformSettings
from rse_pf.errors import ConfigurationError, MissingExtra
from rse_pf.native import load_core
from rse_pf.pnp.native_solver import open_solver
from rse_pf.terminal import show

__all__ = ["ACTION", "Finding", "check_machine", "report"]

# File descriptors that the load balancer needs for each robot: one towards the robot, one towards its server.
_DESCRIPTORS_PER_ROBOT = 2
# File descriptors that the load balancer needs besides those of robots.
_OTHER_DESCRIPTORS = 256
# Available memory below which a warning is printed, in MiB: about what the demo needs.
_LITTLE_MEMORY_MIB = 1024
# Time limit of ``envoy --version``, in seconds.
_ENVOY_TIMEOUT_S = 10.0
_ISOLATION_FIX = "allow user namespaces: sysctl -w user.max_user_namespaces=10000"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """The result of one check: ``grade`` is ok, warn or fail, ``what`` the sentence that is shown.

    ``fix`` is what the user can do, "" if the grade is ok.
    """

    grade: str
    what: str
    fix: str = ""

    def lines(self) -> list[str]:
        """Return the lines that show this result: one, or two with a fix."""
        return [f"{self.grade:<4}  {self.what}", *([f"      fix: {self.fix}"] if self.fix else [])]


def check_this_machine(request: NoOptions, settings: PlatformSettings) -> int:
    """Check this machine and print every result; return 1 if any failed, else 0."""
    has_demo = find_defect("cv2", EXTRAS["demo"].modules["cv2"]) is None
    return report(check_machine(settings), f"ready: rse-pf local{', or rse-pf demo' if has_demo else ''}")


def report(findings: Iterable[Finding], ready: str) -> int:
    """Print each of *findings* when it is known, then how many failed, or the line *ready* if none did.

    Returns the exit code: 1 if any failed, else 0.
    """
    failed = 0
    for finding in findings:
        show(*finding.lines())
        failed += finding.grade == "fail"
    show("", f"{failed} to fix first" if failed else ready)
    return 1 if failed else 0


def check_machine(settings: PlatformSettings) -> Iterator[Finding]:
    """Check this machine for the platform, and yield the results in the order in which to fix them."""
    checks: tuple[Callable[[PlatformSettings], Iterator[Finding]], ...] = (
        _system, _extras, _solver, _isolation, _balancer, _listener, _open_files, _size,
    )  # fmt: skip
    for check in checks:
        yield from check(settings)


def _system(settings: PlatformSettings) -> Iterator[Finding]:
    yield Finding(grade="ok", what=f"Python {platform.python_version()}")
    system, machine = platform.system(), platform.machine()
    fix = "run the platform on Linux, x86-64" if (system, machine) != ("Linux", "x86_64") else ""
    yield _finding(f"{system} on {machine}", fix, is_required=system != "Linux")


def _extras(settings: PlatformSettings) -> Iterator[Finding]:
    """Yield one result for each extra, one with the verbs that work, and one for each verb that does not."""
    packages = {module: name for extra in EXTRAS.values() for module, name in extra.modules.items()}
    found = {module: find_defect(module, package) for module, package in packages.items()}
    defects = {module: defect for module, defect in found.items() if defect is not None}
    for name, extra in EXTRAS.items():
        broken = [defects[module] for module in extra.modules if module in defects]
        fixes = [defect.fix or MissingExtra.command(*([] if name == "base" else [name])) for defect in broken]
        absent = [module for module in extra.modules if module in defects and not defects[module].fix]
        problems = [f"{', '.join(absent)} cannot be imported"] if absent else []
        problems += [defect.problem for defect in broken if defect.fix]
        title = f"extra {name}: {'; '.join(problems)}" if broken else f"extra {name}"
        fix = " && ".join(dict.fromkeys(fixes))
        yield _finding(f"{title}; for {extra.enables}", fix, is_required=extra.is_required)
    yield from _verbs(defects)


def _verbs(defects: Mapping[str, Defect]) -> Iterator[Finding]:
    """Yield which verbs work if the modules in *defects* do not, and a warning for each other verb."""
    lacking = {
        verb: [extra for extra in extras if defects.keys() & modules_of(extra).keys()]
        for verb, extras in VERBS_NEED.items()
    }
    yield _finding(f"verbs that work here: {', '.join(verb for verb, lacks in lacking.items() if not lacks)}")
    for verb, lacks in lacking.items():
        if lacks:
            broken = {module for extra in lacks for module in defects.keys() & modules_of(extra).keys()}
            title = f"rse-pf {verb} does not work here: it needs {', '.join(sorted(broken))}"
            fixes = [defects[module].fix or MissingExtra.command(*lacks) for module in sorted(broken)]
            yield _finding(title, " && ".join(dict.fromkeys(fixes)))


def _solver(settings: PlatformSettings) -> Iterator[Finding]:
    from rse_pf.pnp.engines import engine_for

    try:
        core = load_core(open_solver)
        engine_for(settings.pnp.engine)
    except ConfigurationError as error:
        yield _finding(f"solver: {error.message}", error.hint, is_required=True)
        return
    yield _finding(f"solver: engine {settings.pnp.engine}, native core with {core.lanes} instructions")


def _isolation(settings: PlatformSettings) -> Iterator[Finding]:
    """Yield the kinds of isolation that sandboxes of custom services have here; a warning if some lack."""
    from rse_pf.server.sandbox import isolation
    from rse_pf.server.sandbox.child import readable_paths

    def make_root() -> None:
        isolation.enter_namespaces()
        isolation.make_root(readable_paths([]), 1 << 20, os.getuid())

    missing = isolation.missing_isolation(
        [
            isolation.enter_namespaces,
            make_root,
            lambda: isolation.give_up_privileges(None),
            isolation.forbid_system_calls,
        ]
    )
    present = ", ".join(name for name in isolation.ISOLATION if name not in missing)
    title = f"isolation of custom services: {present or 'none'}"
    title += f"; missing: {', '.join(missing)}" if missing else ""
    yield _finding(title, _ISOLATION_FIX if missing else "")


def _balancer(settings: PlatformSettings) -> Iterator[Finding]:
    from rse_pf.local.balancer.load_balancer import envoy_binary

    try:
        binary = envoy_binary()
        completed = subprocess.run(
            [binary, "--version"], capture_output=True, text=True, timeout=_ENVOY_TIMEOUT_S, check=True
        )
    except MissingExtra as error:
        yield Finding(grade="fail", what=error.message, fix=error.hint)
    except (OSError, subprocess.SubprocessError) as error:
        yield Finding(
            grade="fail",
            what=f"Envoy does not run: {error}",
            fix="it needs glibc 2.31 and x86-64; update both",
        )
    else:
        parts = completed.stdout.strip().partition("version:")[2].split("/")
        yield Finding(grade="ok", what=f"Envoy {parts[1] if len(parts) > 1 else ''} runs")


def _listener(settings: PlatformSettings) -> Iterator[Finding]:
    from rse_pf.local.firewall import check_listener

    address = f"{settings.serving.host}:{settings.local.port}"
    try:
        check_listener(settings.serving.host, settings.local.port)
    except ConfigurationError as error:
        yield Finding(
            grade="warn", what=f"listener {address}: {error.message}", fix="rse-pf local stop, or --port 0"
        )
    else:
        yield Finding(grade="ok", what=f"listener {address} is free")


def _open_files(settings: PlatformSettings) -> Iterator[Finding]:
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    if most == resource.RLIM_INFINITY:
        yield Finding(grade="ok", what="open files: no limit")
        return
    needed = settings.serving.max_robots * _DESCRIPTORS_PER_ROBOT + _OTHER_DESCRIPTORS
    robots = max(0, (most - _OTHER_DESCRIPTORS) // _DESCRIPTORS_PER_ROBOT)
    title = f"open files: {most}, enough for {robots} robots through one load balancer"
    fix = ""
    if most < needed:
        title += f"; serving.max_robots is {settings.serving.max_robots}"
        fix = f"raise the hard limit (ulimit -Hn) to {needed}, or lower serving.max_robots"
    yield _finding(title, fix)


def _size(settings: PlatformSettings) -> Iterator[Finding]:
    cores = len(os.sched_getaffinity(0))
    processes = settings.local.servers * (settings.serving.workers or 1)
    fix = f"expect shared cores: local.servers x serving.workers = {processes}" if cores < processes else ""
    yield _finding(f"{cores} cores", fix)
    match = None
    with contextlib.suppress(OSError):
        match = re.search(r"MemAvailable: *(\d+) kB", Path("/proc/meminfo").read_text(encoding="ascii"))
    if match is None:
        yield _finding("memory unknown")
        return
    title = f"{int(match[1]) // 1024} MiB of memory available"
    fix = f"free some: the demo needs about {_LITTLE_MEMORY_MIB} MiB"
    yield _finding(title, fix if int(match[1]) // 1024 < _LITTLE_MEMORY_MIB else "")


def _finding(what: str, fix: str = "", *, is_required: bool = False) -> Finding:
    """Return the result *what*: ok if *fix* is "", else a warning, or a failure if *is_required*."""
    grade = "fail" if is_required else "warn"
    return Finding(grade=grade if fix else "ok", what=what, fix=fix)


ACTION = Action(request=NoOptions, run=check_this_machine)
