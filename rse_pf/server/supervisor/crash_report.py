"""Find out after a crash in native code for which robot a worker was computing, and where.

Worker and supervisor share the memory of the report.  While a thread of the worker decodes a message of a
connection or computes for it, the number of the connection is in that memory.  `faulthandler` writes the
traceback of the crash behind it, and costs nothing before.  A crash at any other time is charged to no robot.
"""

from __future__ import annotations

import faulthandler
import itertools
import mmap
import os
import re
import signal
import struct
from contextlib import suppress
from dataclasses import dataclass
from threading import get_ident

import msgspec

from rse_pf.identity import RobotId

__all__ = ["CRASH_SIGNALS", "Crash", "CrashReport"]

CRASH_SIGNALS = (signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGABRT)
"""Signals by which native code ends a process; operators and the kernel use others."""
_MAX_THREADS = 4  # threads of a worker that are recorded: event loop, solver and decoder are three
_THREADS = _MAX_THREADS  # index of the first word with a thread id; the words before hold connection numbers
_ENTRY = struct.Struct("@QH")  # number of a connection, and length of its robot's name as JSON
_ENTRY_BYTES = 640  # size of an entry with the name
_ENTRIES = 128  # newest connections in the table of robots; the supervisor's registry has the older ones
_TABLE = 8 * 2 * _MAX_THREADS  # offset of the table behind the words, in bytes
_TEXT = mmap.PAGESIZE * -(-(_TABLE + _ENTRY_BYTES * _ENTRIES) // mmap.PAGESIZE)
_MAX_TEXT_BYTES = 1 << 17
_THREAD = re.compile(rb"Current thread 0x([0-9a-f]{1,16}) ")
_FRAME = re.compile(rb'File "([^"\n]{1,500})", line (\d{1,9}) in ([^\n]{1,200})')


@dataclass(frozen=True, slots=True)
class Crash:
    """One crash.

    Attributes:
        number: Number of the connection for which the thread worked; 0 for none.
        robot: Its robot; None if the connection is not among the newest, or has no token.
        place: File, line and name of the innermost Python function.
    """

    number: int
    robot: RobotId | None
    place: str


class CrashReport:
    """The report of one worker; made before the worker is forked."""

    def __init__(self) -> None:
        self._file = os.memfd_create("crash-report")
        os.ftruncate(self._file, _TEXT)
        os.lseek(self._file, _TEXT, os.SEEK_SET)
        self._memory = mmap.mmap(self._file, _TEXT)
        self._words = memoryview(self._memory)[:_TABLE].cast("Q")
        self.of_loop = self._words[:1]
        """The connection for which the thread of the event loop works, in its only element; 0 for none."""
        self._indices: dict[int, int] = {}
        """Which word belongs to a thread."""
        self._unused = itertools.count()

    # --- in the worker -------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Report crashes of this process from now on; called in the thread of its event loop."""
        self.compute_for(0)
        faulthandler.enable(self._file)

    def enter(self, number: int, robot: RobotId) -> None:
        """Note the robot of the new connection *number*."""
        name = msgspec.json.encode(robot)[: _ENTRY_BYTES - _ENTRY.size]
        at = _TABLE + number % _ENTRIES * _ENTRY_BYTES
        self._memory[at : at + _ENTRY.size + len(name)] = _ENTRY.pack(number, len(name)) + name

    def compute_for(self, number: int) -> int:
        """Note that this thread works for the connection *number* from now on; return the one before.

        0 stands for none.
        """
        thread = get_ident()
        index = self._indices.get(thread)
        if index is None:
            index = self._indices[thread] = next(self._unused)
            if index < _MAX_THREADS:
                self._words[_THREADS + index] = thread
        if index >= _MAX_THREADS:
            return 0
        before = self._words[index]
        self._words[index] = number
        return before

    # --- in the supervisor ---------------------------------------------------------------------------------

    def read(self) -> Crash:
        """Return the crash; called when the worker has ended."""
        text = os.pread(self._file, _MAX_TEXT_BYTES, _TEXT)
        found = _THREAD.search(text)
        frame = None if found is None else _FRAME.search(text, found.end())
        thread = 0 if found is None else int(found[1], 16)
        threads = self._words[_THREADS:].tolist()
        number = self._words[threads.index(thread)] if thread and thread in threads else 0
        place = b"" if frame is None else b"%b:%b %b" % (frame[1], frame[2], frame[3])
        return Crash(number, self._robot_of(number), place.decode(errors="replace"))

    def close(self) -> None:
        """Free the memory."""
        if self._file >= 0:
            self.of_loop.release()
            self._words.release()
            self._memory.close()
            os.close(self._file)
            self._file = -1

    def _robot_of(self, number: int) -> RobotId | None:
        at = _TABLE + number % _ENTRIES * _ENTRY_BYTES
        entered, length = _ENTRY.unpack_from(self._memory, at)
        if not number or entered != number:
            return None
        with suppress(msgspec.DecodeError):
            return RobotId(*msgspec.json.decode(self._memory[at + _ENTRY.size :][:length], type=list[str]))
        return None
