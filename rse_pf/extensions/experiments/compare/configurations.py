"""The configurations that ``rse-pf compare`` compares: a built-in name, a file, or a function for features.

A file ``NAME.toml`` sets options; a file ``NAME.py`` sets options and functions by module-level names, and is
run in this process.  Every mistake in a file is reported as a UsageError of one line.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from client_sdk.frontend import FrontEndOptions, MonocularOptions
from client_sdk.plugins import load_features
from rse_pf.config.validation import did_you_mean
from rse_pf.errors import RsePfError, UsageError
from rse_pf.storage.files import read_document

__all__ = ["BUILT_IN", "SLOTS", "Configuration", "configurations_of", "failure_line"]

BUILT_IN = {
    "default": "what a robot's mapper does by itself",
    "live": "the features of live maps: the strongest, wherever they are",
    "wide-baseline": "as rse-pf demo --frontend wide-baseline",
    "without-depth": "the colours only; the scale is unknown",
    "features-N": "with N features in each frame, such as features-500",
    "MODULE:FUNCTION": "with features of your own, as for rse-pf demo --features",
}
"""The built-in configurations of the tracker: name, and one line of help."""
SLOTS = ("features", "motion", "loops", "optimiser")
"""Functions that a Python file may set; each is the argument of `Mapper` of the same name."""
# Names of the options that the file of a configuration may set.
_OPTIONS = ("base", "depth", "frontend", "monocular")
# Pattern of the built-in configuration ``features-N``, with N features.
_FEATURES = re.compile(r"features-(\d{1,6})")
# Smallest N of ``features-N``.
_MIN_FEATURES = 50
# Largest N of ``features-N``.
_MAX_FEATURES = 20_000
# Largest TOML file, in bytes: the time to parse a dotted name grows with the square of its parts.
_MAX_BYTES = 16 << 10
_Options = TypeVar("_Options", FrontEndOptions, MonocularOptions)


@dataclass(frozen=True, slots=True, kw_only=True)
class Configuration:
    """A configuration of the tracker.

    ``depth`` says whether depth images are used; None uses them if the recording has some.  ``slots`` holds
    the user's functions by the names of `SLOTS`; ``source`` is the file that set them, empty if built in.
    """

    name: str
    frontend: FrontEndOptions = field(default_factory=FrontEndOptions)
    monocular: MonocularOptions = field(default_factory=MonocularOptions)
    depth: bool | None = None
    slots: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    source: str = ""


def configurations_of(words: Sequence[str]) -> list[Configuration]:
    """Return the configurations that *words* name, in the same order.

    Raises:
        UsageError: A word is neither a built-in name nor a usable file, or two configurations have the same
            name.
    """
    found = [_configuration(word) for word in words]
    names = [configuration.name for configuration in found]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(
                f"two configurations are called {name}", hint="name each once, or rename one of the files"
            )
    return found


def failure_line(path: str, error: BaseException) -> str:
    """Return one line about *error* raised by the user's file *path*: file, line number, type and message."""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == path]
    line = error.lineno if isinstance(error, SyntaxError) else (lines[-1] if lines else None)
    said = (error.msg if isinstance(error, SyntaxError) else str(error)).strip().split("\n")[0]
    return f"{path}{'' if line is None else f', line {line}'}: {type(error).__name__}: {said}"


def _configuration(word: str) -> Configuration:
    path = Path(word)
    if ":" in word and path.suffix not in (".toml", ".py"):
        features = load_features(word)
        assert features is not None
        file = inspect.getsourcefile(inspect.unwrap(features)) if inspect.isfunction(features) else None
        return Configuration(name=word, slots={"features": features}, source=file or word)
    if path.suffix not in (".toml", ".py"):
        return _built_in(word)
    if not path.is_file():
        raise UsageError(f"there is no file {word}", hint="name a configuration: NAME.toml or NAME.py")
    values, slots = _read_toml(path) if path.suffix == ".toml" else _read_python(path)
    try:
        return _from_values(path, values, slots)
    except UsageError as error:
        raise UsageError(f"{word}: {error.message}", hint=error.hint) from error


def _built_in(name: str) -> Configuration:
    plain = {
        "default": Configuration(name=name),
        "live": Configuration(name=name, frontend=FrontEndOptions.live()),
        "wide-baseline": Configuration(name=name, frontend=FrontEndOptions.wide_baseline()),
        "without-depth": Configuration(name=name, depth=False),
    }
    if name in plain:
        return plain[name]
    counted = _FEATURES.fullmatch(name)
    if counted is None:
        raise UsageError(
            f"there is no configuration {name!r}",
            hint=did_you_mean(name, BUILT_IN, f"write one of {', '.join(BUILT_IN)}, or a file"),
        )
    features = int(counted[1])
    if not _MIN_FEATURES <= features <= _MAX_FEATURES:
        raise UsageError(
            f"{name}: {features} features are not within {_MIN_FEATURES}..{_MAX_FEATURES}",
            hint="1000 is the default",
        )
    return Configuration(
        name=name,
        frontend=replace(FrontEndOptions(), features=features),
        monocular=replace(MonocularOptions(), features=features),
    )


def _from_values(
    path: Path, values: Mapping[str, Any], slots: Mapping[str, Callable[..., Any]]
) -> Configuration:
    base = values.get("base", "default")
    if not isinstance(base, str):
        raise UsageError(
            "base is not the name of a configuration", hint=f"write one of {', '.join(BUILT_IN)}"
        )
    start = _built_in(base)
    depth = values.get("depth", start.depth)
    if depth is not None and not isinstance(depth, bool):
        raise UsageError(f"depth = {depth!r} is neither true nor false", hint="leave it out to use any")
    return Configuration(
        name=path.stem,
        frontend=_changed("frontend", start.frontend, values.get("frontend", {})),
        monocular=_changed("monocular", start.monocular, values.get("monocular", {})),
        depth=depth,
        slots=slots,
        source=str(path),
    )


def _changed(section: str, options: _Options, values: Any) -> _Options:
    """Return *options* with the values of a table; a complete options object in *values* replaces them.

    Raises:
        UsageError: *values* is no table, an option is unknown, or a value has another type than the default.
    """
    if isinstance(values, type(options)):
        return values
    if not isinstance(values, Mapping):
        raise UsageError(f"{section} is no table", hint=f"write [{section}] and lines such as features = 500")
    known = {each.name: getattr(options, each.name) for each in fields(options)}
    checked: dict[str, Any] = {}
    for name, value in values.items():
        now = known.get(name)
        if not isinstance(now, bool | int | float):
            simple = [each for each, kept in known.items() if isinstance(kept, bool | int | float)]
            raise UsageError(
                f"{section} has no option {name}", hint=did_you_mean(str(name), simple, ", ".join(simple))
            )
        wanted = float if isinstance(now, float) else type(now)
        fits = type(value) is wanted or (wanted is float and type(value) is int)
        if not fits:
            raise UsageError(
                f"{section}.{name} = {value!r} is no {wanted.__name__}", hint=f"the default is {now!r}"
            )
        checked[str(name)] = wanted(value)
    return replace(options, **checked)


def _read_toml(path: Path) -> tuple[Mapping[str, Any], Mapping[str, Callable[..., Any]]]:
    if importlib.util.find_spec("tomllib") is None:
        raise UsageError(
            f"{path}: Python {sys.version_info.major}.{sys.version_info.minor} reads no TOML",
            hint="use Python 3.11, or write the same in NAME.py",
        )
    toml: Any = importlib.import_module("tomllib")
    values: dict[str, Any] = read_document(
        path, "TOML", hint='write lines such as base = "default"', parse=toml.loads, max_bytes=_MAX_BYTES
    )
    for name in values:
        if name not in _OPTIONS:
            hint = did_you_mean(name, _OPTIONS, f"known are {', '.join(_OPTIONS)}")
            if name in SLOTS:
                hint = "functions need a Python file: NAME.py"
            raise UsageError(f"{path} sets {name}, which is no part of a configuration", hint=hint)
    return values, {}


def _read_python(path: Path) -> tuple[Mapping[str, Any], Mapping[str, Callable[..., Any]]]:
    module = _module_of(path)
    values = {name: getattr(module, name) for name in _OPTIONS if hasattr(module, name)}
    slots = {name: getattr(module, name) for name in SLOTS if getattr(module, name, None) is not None}
    for name, slot in slots.items():
        if not callable(slot):
            raise UsageError(f"{path}: {name} is no function", hint=f"write def {name}(...)")
    if not values and not slots:
        raise UsageError(
            f"{path} sets nothing that is compared",
            hint=f"set one of {', '.join((*_OPTIONS, *SLOTS))}, or name its function: {path.stem}:FUNCTION",
        )
    return values, slots


def _module_of(path: Path) -> Any:
    """Import the user's file *path* as a module; it may import other files of the same folder.

    Raises:
        UsageError: The file raised an exception.
    """
    spec = importlib.util.spec_from_file_location(f"compared_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    folder = str(path.resolve().parent)
    if folder not in sys.path:
        sys.path.append(folder)
    try:
        spec.loader.exec_module(module)
    except RsePfError as error:
        raise UsageError(f"{path}: {error.message}", hint=error.hint) from error
    except (Exception, SystemExit) as error:
        raise UsageError(
            failure_line(str(path), error), hint=f"run it alone to see more: python {path}"
        ) from error
    return module
