"""Read what a shared library asks of the machine that loads it.

Reads 64-bit little-endian ELF files through their program headers, as the loader does, so sections may be
stripped.

Source: System V ABI, chapter 5; the version needs are those of the Linux Standard Base, section 10.7.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

_HEADER = struct.Struct("<16sHHIQQQIHHH")
_PROGRAM = struct.Struct("<IIQQQQQQ")
_DYNAMIC = struct.Struct("<qQ")
_NEED = struct.Struct("<HHIII")
_NEEDED_VERSION = struct.Struct("<IHHII")
_MACHINES = {62: "x86_64", 183: "aarch64"}
_LOAD, _DYNAMIC_SEGMENT, _STACK = 1, 2, 0x6474E551
_EXECUTABLE = 1
_END, _LIBRARY, _STRINGS, _TEXT_RELOCATIONS = 0, 1, 5, 22
_VERSION_NEEDS, _VERSION_NEEDS_COUNT = 0x6FFFFFFE, 0x6FFFFFFF

NEWEST_GLIBC = (2, 28)
"""Of Debian 10 and Amazon Linux 2023, and of the wheel's platform tag."""
_LIBRARIES = re.compile(r"libc\.so\.6|ld-linux-(x86-64|aarch64)\.so\.[12]")


class ElfError(ValueError):
    """The bytes are no shared library that this module can read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SharedLibrary:
    """What the loader is told.

    Attributes:
        machine: ``x86_64`` or ``aarch64``.
        needed: Names of the libraries that are loaded with it.
        versions: Versions of symbols that it needs, such as ``GLIBC_2.18``.
        executable_stack: Whether it asks for one.
        text_relocations: Whether its code is written to at loading.
    """

    machine: str
    needed: tuple[str, ...]
    versions: tuple[str, ...]
    executable_stack: bool
    text_relocations: bool


def read_library(data: bytes) -> SharedLibrary:
    """Return what the shared library *data* asks for.

    Raises:
        ElfError: It is none, or it is cut off.
    """
    try:
        return _read(data)
    except (struct.error, ValueError, IndexError) as error:
        raise ElfError(f"no shared library: {error}") from error


def complaints(library: SharedLibrary, machine: str) -> list[str]:
    """Return why *library* may not be shipped for *machine*; nothing if it may."""
    found = []
    if library.machine != machine:
        found.append(f"it is for {library.machine}, not for {machine}")
    found += [
        f"it needs {name}: link it statically" for name in library.needed if not _LIBRARIES.fullmatch(name)
    ]
    for version in library.versions:
        family, _, number = version.partition("_")
        if family != "GLIBC":
            found.append(f"it needs the symbols {version}: link that library statically")
        elif tuple(int(part) for part in number.split(".")) > NEWEST_GLIBC:
            found.append(f"it needs {version}, newer than GLIBC_{'.'.join(map(str, NEWEST_GLIBC))}")
    if library.executable_stack:
        found.append("its stack is executable")
    if library.text_relocations:
        found.append("its code is relocated at loading: compile with -fPIC")
    return found


def _read(data: bytes) -> SharedLibrary:
    ident, kind, machine, _, _, at, _, _, _, size, count = _HEADER.unpack_from(data)
    if ident[:6] != b"\x7fELF\x02\x01" or kind != 3 or size != _PROGRAM.size:
        raise ValueError("the header is another")
    if machine not in _MACHINES:
        raise ValueError(f"machine {machine}")
    programs = [_PROGRAM.unpack_from(data, at + i * size) for i in range(count)]
    stacks = [flags for kind, flags, *_ in programs if kind == _STACK]
    loads = [(start, offset, length) for kind, _, offset, start, _, length, _, _ in programs if kind == _LOAD]
    (dynamic,) = [
        (offset, length) for kind, _, offset, _, _, length, *_ in programs if kind == _DYNAMIC_SEGMENT
    ]
    tags = _tags(data, *dynamic)
    values = dict(tags)
    strings = _offset(loads, values[_STRINGS])

    def text(index: int) -> str:
        return data[strings + index : data.index(b"\0", strings + index)].decode("ascii")

    versions: set[str] = set()
    if _VERSION_NEEDS in values:
        need_at = _offset(loads, values[_VERSION_NEEDS])
        for _ in range(values[_VERSION_NEEDS_COUNT]):
            _, entries, _, first, following = _NEED.unpack_from(data, need_at)
            entry_at = need_at + first
            for _ in range(entries):
                _, _, _, name, next_entry = _NEEDED_VERSION.unpack_from(data, entry_at)
                versions.add(text(name))
                entry_at += next_entry
            need_at += following
    return SharedLibrary(
        machine=_MACHINES[machine],
        needed=tuple(text(value) for tag, value in tags if tag == _LIBRARY),
        versions=tuple(sorted(versions)),
        # Without the header, the loader makes the stack executable.
        executable_stack=not stacks or any(flags & _EXECUTABLE for flags in stacks),
        text_relocations=_TEXT_RELOCATIONS in values,
    )


def _tags(data: bytes, offset: int, length: int) -> list[tuple[int, int]]:
    tags = []
    for at in range(offset, offset + length, _DYNAMIC.size):
        tag, value = _DYNAMIC.unpack_from(data, at)
        if tag == _END:
            break
        tags.append((tag, value))
    return tags


def _offset(loads: list[tuple[int, int, int]], address: int) -> int:
    for start, offset, length in loads:
        if start <= address < start + length:
            return offset + address - start
    raise ValueError(f"address {address:#x} is not in the file")
