"""Report, after a crash of a worker in native code, for which robot the worker was computing, and where.

1. Supervisor and worker share the memory of the report.
2. While a thread of the worker decodes a message of a connection or computes for it, the number of the
   connection is in that memory.  At other times it is 0, and a crash is charged to no robot.
3. At a crash, `faulthandler` writes the traceback of the thread into the file of the memory.
4. The supervisor reads the thread from the traceback, and the connection and its robot from the memory.

Layout of the memory: for each of `_MAX_THREADS` threads a word with a connection number, then for each a word
with its thread id; a table with the robots of the newest connections; the text of `faulthandler`.
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
"""Signals that kill a process after an error in native code; operators and the kernel use other signals."""
_MAX_THREADS = 4  # threads of a worker that are recorded: event loop, solver and decoder are three
_THREADS = _MAX_THREADS  # index of the first word with a thread id; the words before have connection numbers
_ENTRY = struct.Struct("@QH")  # begin of a table entry: connection number, and bytes of its robot as JSON
_ENTRY_BYTES = 640  # bytes of a table entry, with the robot as JSON
_ENTRIES = 128  # entries of the table, for the newest connections; the supervisor's registry has older ones
_TABLE = 8 * 2 * _MAX_THREADS  # offset of the table in bytes, behind two words of 8 bytes for each thread
# Offset of the text of `faulthandler`: the first memory page behind the table.
_TEXT = mmap.PAGESIZE * -(-(_TABLE + _ENTRY_BYTES * _ENTRIES) // mmap.PAGESIZE)
_MAX_TEXT_BYTES = 1 << 17  # bytes of the text of `faulthandler` that the supervisor reads at most
_THREAD = re.compile(rb"Current thread 0x([0-9a-f]{1,16}) ")
_FRAME = re.compile(rb'File "([^"\n]{1,500})", line (\d{1,9}) in ([^\n]{1,200})')


@dataclass(frozen=True, slots=True)
class Crash:
    """What a report says about the crash of a worker.

    Attributes:
        number: Number of the connection for which the crashed thread worked; 0 for none.
        robot: The robot of that connection; None if the connection is not in the table, or has no token.
        place: ``FILE:LINE FUNCTION`` of the innermost Python function; "" if the traceback is missing.
    """

    number: int
    robot: RobotId | None
    place: str


class CrashReport:
    """The crash report of one worker, in memory that it shares with the supervisor; made before the fork.

    The worker calls `begin`, `enter` and `compute_for`; the supervisor calls `read` and `close`.
    """

    def __init__(self) -> None:
        self._file = os.memfd_create("crash-report")
        os.ftruncate(self._file, _TEXT)
        os.lseek(self._file, _TEXT, os.SEEK_SET)
        self._memory = mmap.mmap(self._file, _TEXT)
        self._words = memoryview(self._memory)[:_TABLE].cast("Q")
        self.of_loop = self._words[:1]
        """One element: the number of the connection for which the event loop's thread works; 0 for none."""
        self._indices: dict[int, int] = {}
        """Index of the word of each thread, by thread id."""
        self._unused = itertools.count()

    def begin(self) -> None:
        """Report crashes of this process from now on; the thread of its event loop must call this first."""
        self.compute_for(0)
        faulthandler.enable(self._file)

    def enter(self, number: int, robot: RobotId) -> None:
        """Write the robot of the new connection *number* into the table, over that of an old connection."""
        name = msgspec.json.encode(robot)[: _ENTRY_BYTES - _ENTRY.size]
        at = _TABLE + number % _ENTRIES * _ENTRY_BYTES
        self._memory[at : at + _ENTRY.size + len(name)] = _ENTRY.pack(number, len(name)) + name

    def compute_for(self, number: int) -> int:
        """Mark that the calling thread works for the connection *number* from now on; 0 for none.

        Return the number that was marked before.  Threads beyond `_MAX_THREADS` are not marked, and get 0.
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

    def read(self) -> Crash:
        """Return the crash of the worker, which has exited."""
        text = os.pread(self._file, _MAX_TEXT_BYTES, _TEXT)
        found = _THREAD.search(text)
        frame = None if found is None else _FRAME.search(text, found.end())
        thread = 0 if found is None else int(found[1], 16)
        threads = self._words[_THREADS:].tolist()
        number = self._words[threads.index(thread)] if thread and thread in threads else 0
        place = b"" if frame is None else b"%b:%b %b" % (frame[1], frame[2], frame[3])
        return Crash(number, self._robot_of(number), place.decode(errors="replace"))

    def close(self) -> None:
        """Free the shared memory; a second call does nothing."""
        if self._file >= 0:
            self.of_loop.release()
            self._words.release()
            self._memory.close()
            os.close(self._file)
            self._file = -1

    def _robot_of(self, number: int) -> RobotId | None:
        """Return the robot of the connection *number* from the table; None if its entry was overwritten."""
        at = _TABLE + number % _ENTRIES * _ENTRY_BYTES
        entered, length = _ENTRY.unpack_from(self._memory, at)
        if not number or entered != number:
            return None
        with suppress(msgspec.DecodeError):
            return RobotId(*msgspec.json.decode(self._memory[at + _ENTRY.size :][:length], type=list[str]))
        return None
