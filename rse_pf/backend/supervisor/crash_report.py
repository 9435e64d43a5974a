"""What a worker leaves behind when native code ends its process: which robot it computed for, and where.

The report is memory that worker and supervisor share.  The worker writes the number of a connection there
before it decodes or computes for it; the traceback of the crash is written by `faulthandler`, whose handler
costs nothing before.  Nobody is named for a crash in any other thread.
"""

from __future__ import annotations

import faulthandler
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
"""How native code ends a process; an operator or the kernel uses other signals."""
_LOOP, _SOLVER = 0, 1
_LOOP_THREAD, _SOLVER_THREAD = 2, 3
"""Words of the memory: connection numbers, and the threads that compute for them."""
_ENTRY = struct.Struct("@QH")
_ENTRY_BYTES, _ENTRIES = 640, 128
"""The robots of the newest connections, which the supervisor may not have heard of yet."""
_TABLE = 64
_TEXT = mmap.PAGESIZE * -(-(_TABLE + _ENTRY_BYTES * _ENTRIES) // mmap.PAGESIZE)
_MAX_TEXT_BYTES = 1 << 17
_THREAD = re.compile(rb"Current thread 0x([0-9a-f]{1,16}) ")
_FRAME = re.compile(rb'File "([^"\n]{1,500})", line (\d{1,9}) in ([^\n]{1,200})')


@dataclass(frozen=True, slots=True)
class Crash:
    """One crash: the number of the connection that was computed for, 0 if none was, and its robot.

    ``robot`` is None if the connection is no recent one, or has no token; ``place`` is the innermost Python
    function.
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
        self.of_loop = self._words[_LOOP : _LOOP + 1]
        """The connection for which the thread of the event loop works, in its only element; 0 for none."""
        self._loop_thread = 0

    # --- in the worker -------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Report crashes of this process from now on; called in the thread of its event loop."""
        self._loop_thread = self._words[_LOOP_THREAD] = get_ident()
        faulthandler.enable(self._file)

    def enter(self, number: int, robot: RobotId) -> None:
        """Note the robot of the new connection *number*."""
        name = msgspec.json.encode(robot)[: _ENTRY_BYTES - _ENTRY.size]
        at = _TABLE + number % _ENTRIES * _ENTRY_BYTES
        self._memory[at : at + _ENTRY.size + len(name)] = _ENTRY.pack(number, len(name)) + name

    def compute_for(self, number: int) -> None:
        """Note that this thread works for the connection *number* from now on, 0 for none."""
        thread = get_ident()
        if thread == self._loop_thread:
            self._words[_LOOP] = number
        else:
            self._words[_SOLVER_THREAD], self._words[_SOLVER] = thread, number

    # --- in the supervisor ---------------------------------------------------------------------------------

    def read(self) -> Crash:
        """Return what is known of the crash; called when the worker has ended."""
        text = os.pread(self._file, _MAX_TEXT_BYTES, _TEXT)
        found = _THREAD.search(text)
        frame = None if found is None else _FRAME.search(text, found.end())
        thread = 0 if found is None else int(found[1], 16)
        number = 0
        if thread and thread == self._words[_LOOP_THREAD]:
            number = self._words[_LOOP]
        elif thread and thread == self._words[_SOLVER_THREAD]:
            number = self._words[_SOLVER]
        place = b"" if frame is None else b"%b:%b %b" % (frame[1], frame[2], frame[3])
        return Crash(number, self._robot_of(number), place.decode(errors="replace"))

    def close(self) -> None:
        """Give the memory back."""
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
