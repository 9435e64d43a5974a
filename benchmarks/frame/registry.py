"""Benchmarks as functions: how one is registered, found, and run with its arguments.

A benchmark is one function of a module below ``benchmarks``, decorated with `benchmark` and its bars, which
are the limits of its figures.  The name of the benchmark is that of the module (``benchmarks/server/peer.py``
is ``server.peer``), its help is the docstring of the module.  The function returns its figures; this module
measures the load of the machine, compares figures with bars, and prints and writes the report.

The parameters of the function are the arguments of the command line, or the fields of a dataclass if that is
the only parameter.  A parameter without a default is positional.  ``Annotated[int, "text"]`` gives the help
of an argument, and ``Annotated[str, "text", CHOICES]`` the values that are allowed.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import subprocess
import sys
import time
import types
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from benchmarks.frame.report import Bar, check_bars, show, write
from rse_pf.config import PlatformSettings
from rse_pf.errors import RsePfError, UsageError
from rse_pf.extensions.experiments.results.result_folder import environment, load_average

__all__ = ["Bar", "Benchmark", "Recordings", "benchmark", "command_of", "find", "names", "parser_of", "run"]

ROOT = Path(__file__).parents[1]
Recordings = Annotated[Path, "folder of the recordings; it must exist"]
"""Type of an argument that names the folder of recordings."""


@dataclass(frozen=True, slots=True)
class Benchmark:
    """A registered benchmark: the function that measures, and the bars that its figures must hold."""

    measure: Callable[..., dict[str, Any]]
    bars: tuple[Bar, ...]


# Registered benchmarks by name; importing the module of a benchmark registers it.
_REGISTERED: dict[str, Benchmark] = {}


def benchmark(*bars: Bar) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Register the decorated function as the benchmark of its module, with *bars*."""

    def register(measure: Callable[..., Any]) -> Callable[..., Any]:
        _REGISTERED[measure.__module__] = Benchmark(measure, bars)
        return measure

    return register


def names() -> Iterator[tuple[str, str]]:
    """Yield the name and the first line of the help of every benchmark, without importing the benchmarks."""
    for path in sorted(ROOT.glob("*/*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        calls = (
            call for node in tree.body if isinstance(node, ast.FunctionDef) for call in node.decorator_list
        )
        if any(isinstance(call, ast.Call) and ast.unparse(call.func) == "benchmark" for call in calls):
            yield f"{path.parent.name}.{path.stem}", (ast.get_docstring(tree) or "").partition("\n")[0]


def find(name: str) -> Benchmark:
    """Import the benchmark *name*; raises UsageError for an unknown name."""
    if name not in dict(names()):
        raise UsageError(f"there is no benchmark {name!r}", hint="python -m benchmarks lists them")
    module = f"benchmarks.{name}"
    importlib.import_module(module)
    return _REGISTERED[module]


def command_of(function: Callable[..., Any], *arguments: str) -> list[str]:
    """Return the command line that calls *function* of a module with *arguments* in a new process."""
    module, name = function.__module__, function.__name__
    return [
        sys.executable,
        "-c",
        f"import sys; from {module} import {name}; {name}(*sys.argv[1:])",
        *arguments,
    ]


def run(arguments: Sequence[str]) -> int:
    """Run the command line; return 0, or 1 for a missed bar, or 2 if the benchmark cannot be run."""
    top = argparse.ArgumentParser(
        prog="python -m benchmarks", description="Run a benchmark, or list all of them.",
        epilog="python -m benchmarks NAME --help explains one.",
    )  # fmt: skip
    top.add_argument("name", nargs="?", metavar="NAME", help="a benchmark, or 'all' that need no argument")
    top.add_argument("rest", nargs=argparse.REMAINDER, metavar="...", help="its arguments")
    chosen = top.parse_args(arguments)
    try:
        if chosen.name is None:
            known = dict(names())
            width = max(map(len, known))
            print("\n".join(f"{name:{width}}  {line}" for name, line in known.items()))
            return 0
        if chosen.name == "all":
            return _run_all(chosen.rest)
        return _run_one(chosen.name, chosen.rest)
    except RsePfError as error:
        sys.stderr.write(f"cannot measure: {error.report()}\n")
        return 2


def _run_one(name: str, arguments: Sequence[str]) -> int:
    found = find(name)
    given = vars(parser_of(name, found).parse_args(arguments))
    out, is_short = given.pop("out"), given.pop("short")
    for key, hint in _hints(found.measure).items():
        if hint == Recordings and not given[key].is_dir():
            raise UsageError(f"there is no folder {given[key]}", hint="name the folder of recordings")
    holder = _holder(found.measure)
    before, began_s = load_average(), time.monotonic()
    figures = found.measure(**given) if holder is found.measure else found.measure(holder(**given))
    report = {
        "benchmark": name, "options": given if holder is found.measure else asdict(holder(**given)),
        **environment(PlatformSettings()), "load_average": before, "load_average_after": load_average(),
        "took_s": round(time.monotonic() - began_s, 1), "figures": figures,
        "bars": check_bars([bar for bar in found.bars if bar.is_exact or not is_short], figures),
    }  # fmt: skip
    show(report)
    if out is not None:
        write(out, report)
    return int(any(bar["met"] is False for bar in report["bars"]))


def _run_all(arguments: Sequence[str]) -> int:
    folder = Path(arguments[0]) if arguments else Path("out/bench")
    missed = 0
    for name, _ in names():
        print(f"== {name}", flush=True)
        out = str(folder / f"{name}.json")
        code = subprocess.run(
            [sys.executable, "-m", "benchmarks", name, "--out", out], check=False
        ).returncode
        missed |= code not in (0, 2)
        if code == 2:
            print("left out: it needs what is named above")
    return int(missed)


def parser_of(name: str, found: Benchmark) -> argparse.ArgumentParser:
    """Return the parser of the arguments of a benchmark."""
    module = sys.modules[found.measure.__module__]
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks {name}", description=module.__doc__,
        epilog="\n".join(["bars:", *(f"  {bar}" for bar in found.bars)]) if found.bars else None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    hints = _hints(found.measure)
    for key, parameter in inspect.signature(_holder(found.measure)).parameters.items():
        _add(parser, key, hints[key], parameter.default)
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the report as JSON")
    parser.add_argument(
        "--short", action="store_true", help="check only the bars that neither time nor load can miss"
    )
    return parser


def _holder(measure: Callable[..., Any]) -> Callable[..., Any]:
    """Return the dataclass whose fields are the arguments of *measure*, or *measure* itself without one."""
    hints = get_type_hints(measure)
    hints.pop("return", None)
    only = next(iter(hints.values())) if len(hints) == 1 else None
    return only if is_dataclass(only) else measure  # type: ignore[return-value]


def _hints(measure: Callable[..., Any]) -> dict[str, Any]:
    hints = get_type_hints(_holder(measure), include_extras=True)
    hints.pop("return", None)
    return hints


def _add(parser: argparse.ArgumentParser, key: str, hint: Any, default: Any) -> None:
    """Add the argument *key* to the parser; the type in *hint* decides how its text is parsed."""
    text, options = "", dict[str, Any]()
    if get_origin(hint) is Annotated:
        hint, text, *choices = get_args(hint)
        options = {"choices": tuple(choices[0])} if choices else {}
    if get_origin(hint) in (Union, types.UnionType):
        hint = next(kind for kind in get_args(hint) if kind is not type(None))
    if get_origin(hint) in (tuple, list):
        options["nargs"] = "+" if default is inspect.Parameter.empty else "*"
        hint = get_args(hint)[0]
    if get_origin(hint) is Literal:
        options["choices"] = get_args(hint)
        hint = type(get_args(hint)[0])
    is_required = default is inspect.Parameter.empty
    if hint is bool:
        options["action"] = "store_true"
    else:
        options["type"] = hint
        if not is_required and default is not None and default != "" and default != ():
            shown = " ".join(map(str, default)) if isinstance(default, tuple) else default
            text = f"{text} (default: {shown})".strip()
    if is_required:
        parser.add_argument(key, help=text, **options)
    else:
        parser.add_argument(f"--{key.replace('_', '-')}", default=default, help=text, **options)
