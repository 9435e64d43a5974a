"""Find and load the native core, the shared library of C++ functions that compute poses and features.

The library is loaded when its first function is needed, and is required wherever poses or features are
computed.  This module does not compile or install the library; ``native/README.md`` says how.  A call of its
functions releases Python's global interpreter lock.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from rse_pf.errors import ConfigurationError, MissingExtra

__all__ = [
    "PART_ABIS",
    "Workspace",
    "address_of",
    "aligned",
    "core_function",
    "find_library",
    "load_core",
    "load_part",
]

Part = TypeVar("Part")

PART_ABIS = {"check": 2, "cloud": 1, "depth": 1, "match": 4, "native": 5, "stereo": 1, "track": 2}
"""For each part of the core the version of its C header ``native/include/rse_pf_PART.h`` that this package
calls; a library with another version of a part is refused."""

# File name of the shared library of the native core.
_FILE = "librse_pf_native.so"


def find_library() -> Path | None:
    """Return the file of the native core; None if the core is neither installed nor built.

    The library of an installed package ``rse_pf_native`` comes before the one that was built in this
    checkout.
    """
    folders = [Path(__file__).parents[1] / "native" / "build"]
    installed = find_spec("rse_pf_native")
    if installed is not None and installed.origin:
        package = Path(installed.origin).parent
        editable_build = package.parent / "build"
        folders = [package, editable_build, *folders]
    return next((folder / _FILE for folder in folders if (folder / _FILE).is_file()), None)


def address_of(array: npt.NDArray[Any]) -> int:
    """Return the memory address of the first element of *array*, to pass to C as a pointer.

    The caller keeps *array* alive for as long as C uses the address.
    """
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        # A read-only, non-contiguous or empty array; this way takes ten times as long.
        address: int = array.__array_interface__["data"][0]
        return address


def aligned(array: npt.NDArray[Any], dtype: type | None = None) -> npt.NDArray[Any]:
    """Return *array* as a C-contiguous, aligned array of *dtype*, as C reads it.

    The result is *array* itself if *array* is such an array already, else a copy.  None keeps the type of the
    elements.
    """
    if type(array) is np.ndarray and array.dtype.type is dtype and array.flags.carray:
        return array
    contiguous = np.ascontiguousarray(array, dtype=dtype)
    return contiguous if contiguous.flags.aligned else contiguous.copy()


class Workspace(threading.local):
    """Scratch memory for calls of the native core: one array for each thread, which grows when needed."""

    _words = np.empty(0, dtype=np.uint64)

    def words(self, count: int) -> npt.NDArray[np.uint64]:
        """Return an array of at least *count* 8-byte numbers with arbitrary values.

        All calls of one thread share the array, so its content is lost at the next call.
        """
        if len(self._words) < count:
            self._words = np.empty(count, dtype=np.uint64)
        return self._words


def load_part(path: Path, part: str, abi: int, *functions: str) -> list[Any]:
    """Load functions of one part of the native core, after a check of the part's version.

    Args:
        path: File of the library.
        part: Name of the C header without prefix: ``native`` (the PnP solver), ``check``, ``cloud``,
            ``depth``, ``match``, ``stereo`` or ``track``.  The exported function ``rse_pf_PART_abi`` returns
            the part's version.
        abi: Version that the caller needs.
        functions: Exported names of the functions.

    Returns:
        The functions in the order of their names, as ctypes function objects of which neither the argument
        types nor the result type are set.

    Raises:
        ConfigurationError: The library cannot be loaded, lacks a function, or has another version of the
            part.
    """
    hint = "build it again: make native"
    try:
        library = ctypes.CDLL(str(path))
        version = library[f"rse_pf_{part}_abi"]
        loaded = [library[name] for name in functions]
    except (OSError, AttributeError) as error:
        raise ConfigurationError(f"{path} cannot be loaded: {error}", hint=hint) from error
    version.restype = ctypes.c_uint32
    if version() != abi:
        raise ConfigurationError(f"{path} has the {part} ABI {version()}, not {abi}", hint=hint)
    return loaded


def load_core(open_part: Callable[[Path], Part]) -> Part:
    """Find the native core, and return what *open_part* makes of the path of its file.

    Raises:
        MissingExtra: The native core is not installed.
        ConfigurationError: The native core cannot be loaded, or has another version.
    """
    path = find_library()
    if path is None:
        error = MissingExtra("the native core", "vision")
        error.hint = f"make native in a checkout; or pip install its folder native, then {error.hint}"
        raise error
    return open_part(path)


@cache
def core_function(part: str, name: str, arguments: tuple[Any, ...], result: Any) -> Any:
    """Return one function of the native core with its ctypes signature.

    The library is opened for the first call with equal arguments only.  The function takes numpy arrays where
    C has pointers to data of their type; an array that is not C-contiguous and aligned is passed as such a
    copy, so that C must only read it.

    Args:
        part: Part of the core, a key of `PART_ABIS`.
        name: Exported name, such as ``rse_pf_depth_refine``.
        arguments: ctypes types of the arguments.
        result: ctypes type of the result, None for void.

    Raises:
        MissingExtra: The native core is not installed.
        ConfigurationError: The native core cannot be loaded, or has another version.
    """
    (function,) = load_core(lambda path: load_part(path, part, PART_ABIS[part], name))
    function.argtypes, function.restype = arguments, result

    def call(*values: Any) -> Any:
        # The list keeps copies alive until C returns.
        kept = [aligned(value) if isinstance(value, np.ndarray) else value for value in values]
        return function(*[address_of(value) if isinstance(value, np.ndarray) else value for value in kept])

    return call
