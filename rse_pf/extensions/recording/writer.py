"""Write a recording: files of bounded size into a folder of bounded size, whose oldest files are deleted.

The file that is being written is locked, so that other processes that record to the folder do not delete it.
This module does not run in processes that serve robots.
"""

from __future__ import annotations

import fcntl
import importlib.util
import os
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path

from rse_pf.config import PlatformSettings
from rse_pf.errors import MissingExtra, UsageError
from rse_pf.extensions.recording.file_format import (
    FORMAT_VERSION,
    JSON_ENCODING,
    JSON_SCHEMA_ENCODING,
    LIBRARY,
    METADATA_NAME,
    PROFILE,
    SCHEMAS,
    SUFFIX,
    FileName,
    encode_json,
)
from rse_pf.extensions.recording.mcap_file import McapFile

__all__ = ["RecordingWriter", "make_folder", "with_recordings"]

MAX_FILE_BYTES = 1 << 28
"""Size of a file, bytes, at which it is finished and the next one begins."""
_PRUNE_INTERVAL_NS = 10_000_000_000  # time, ns, between two checks of the size of the folder
_RETRY_INTERVAL_NS = 5_000_000_000  # time, ns, after a failed write until a new file is tried
# Number of channels at which the next file begins; MCAP has 16 bits for the number of a channel.
_MAX_CHANNELS = 50_000
_FILE_MODE = 0o600  # recordings are readable by their user only


def with_recordings(settings: PlatformSettings, folder: Path | None) -> PlatformSettings:
    """Return *settings* that record to *folder*, or for None to the folder that they name already.

    The folder is created.  Without any folder, *settings* are returned unchanged.

    Raises:
        MissingExtra: The package mcap is not installed.
        UsageError: Files cannot be written to the folder.
    """
    chosen = settings.recording.folder if folder is None else str(folder)
    if not chosen:
        return settings
    if importlib.util.find_spec("mcap") is None:
        raise MissingExtra("mcap", "local")
    return settings.replace(recording={"folder": str(make_folder(Path(chosen)))})


def make_folder(folder: Path) -> Path:
    """Create *folder* if it is missing, check that files can be written to it, and return its absolute path.

    Raises:
        UsageError: *folder* is a file, or files cannot be written to it.
    """
    folder = folder.absolute()
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file, not a folder", hint="name a folder for recordings")
    probe = folder / f".probe-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"x" * 4096)
    except OSError as error:
        raise UsageError(
            f"cannot write recordings to {folder}: {error.strerror}",
            hint="name a folder that this user can write to, on a disk that is not full",
        ) from error
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
    return folder


class RecordingWriter:
    """Write the messages of one server or robot into files; a new file begins when the last one is full.

    A channel keeps its number across files.  If a write fails, the messages of the unwritten chunk and all
    further ones are dropped and counted in ``dropped``, ``problem`` holds the reason, and a new file is tried
    every five seconds.
    """

    def __init__(
        self,
        folder: Path,
        server: str,
        *,
        started_ns: int,
        max_file_bytes: int = MAX_FILE_BYTES,
        max_bytes: int,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        """Prepare to write; the first message creates the first file.

        Args:
            folder: Existing folder for the files.
            server: Name of the server, which is part of the names of the files.
            started_ns: Unix time of the start, ns, which is part of the names of the files.
            max_file_bytes: Size of a file, bytes, at which the next one begins.
            max_bytes: Size of all recordings in the folder, bytes, above which the oldest ones are deleted.
            metadata: Further values for the metadata record of each file, such as the ``version`` of the
                software.
        """
        self.dropped = 0
        self._waiting = 0
        self.problem = ""
        self._folder = folder
        self._server = server
        self._started = datetime.fromtimestamp(started_ns / 1e9, timezone.utc)
        self._max_file_bytes, self._max_bytes = max_file_bytes, max_bytes
        further = {"version": "", **(metadata or {})}
        self._library = f"{LIBRARY} {further['version']}".strip()
        self._metadata = {
            "format": str(FORMAT_VERSION),
            "server": server,
            "started_s": f"{started_ns / 1e9:.6f}",
            **further,
        }
        self._number = 0
        self._file: McapFile | None = None
        self._fd = -1
        self._path: Path | None = None
        self._known: dict[int, tuple[str, str, tuple[str, str, bytes] | None, Mapping[str, str]]] = {}
        self._numbers: dict[int, int] = {}
        self._json: dict[str, int] = {}
        self._next_channel = 0
        self._pruned_ns = 0
        self._retry_ns = 0

    @property
    def path(self) -> Path | None:
        """The file that is being written; None before the first message, and after a failed write."""
        return self._path

    def channel(self, topic: str, encoding: str, metadata: Mapping[str, str], schema: str = "") -> int:
        """Return the number of a new channel for `add`.

        *schema* is the name of one of `file_format.SCHEMAS`, "" for none.
        """
        self._next_channel += 1
        described = (schema, JSON_SCHEMA_ENCODING, SCHEMAS[schema]) if schema else None
        self._known[self._next_channel] = topic, encoding, described, metadata
        return self._next_channel

    def forget(self, channel: int) -> None:
        """Remove *channel* after its last message, so that later files do not describe it."""
        self._known.pop(channel, None)
        self._numbers.pop(channel, None)

    def add_json(self, topic: str, schema: str, time_ns: int, value: object) -> None:
        """Add *value* as a message to the JSON channel *topic*, which the first message creates."""
        channel = self._json.get(topic)
        if channel is None:
            channel = self._json[topic] = self.channel(topic, JSON_ENCODING, {}, schema)
        self.add(channel, time_ns, encode_json(value))

    def add(self, channel: int, time_ns: int, data: bytes) -> None:
        """Add a message to *channel*; *time_ns* is its Unix time.

        Opens a new file if none is open.  If a write fails, this message and those of the unwritten chunk are
        counted in ``dropped``, and nothing is raised.
        """
        try:
            file = self._file or self._open(time_ns)
            number = self._numbers.get(channel)
            if number is None:
                topic, encoding, schema, metadata = self._known[channel]
                number = self._numbers[channel] = file.channel(topic, encoding, schema, metadata)
            self._waiting += 1
            size = file.size_bytes
            file.add(number, time_ns, data)
            if file.size_bytes != size:
                self._waiting = 0
        except OSError as error:
            self._fail(error, time_ns)

    def flush(self, now_ns: int) -> None:
        """Write the chunk if it is old enough at *now_ns* (Unix time), and close the file if it is full.

        Every ten seconds the oldest recordings are deleted if the folder is too large.
        """
        file = self._file
        if file is None:
            return
        try:
            if file.is_due(now_ns):
                file.flush()
                self._waiting = 0
            if file.size_bytes >= self._max_file_bytes or file.channels >= _MAX_CHANNELS:
                self.close()
            if now_ns - self._pruned_ns >= _PRUNE_INTERVAL_NS:
                self._prune(now_ns)
        except OSError as error:
            self._fail(error, now_ns)

    def close(self) -> None:
        """Finish the file; a later message would begin a new one.  A failed write sets ``problem``."""
        file, self._file = self._file, None
        try:
            if file is not None:
                file.finish()
        except OSError as error:
            self.problem = error.strerror or str(error)
        finally:
            self._close_descriptor()

    def _open(self, now_ns: int) -> McapFile:
        """Create, lock and return the next file.

        Raises OSError if that fails, and within five seconds after a failed write.
        """
        if now_ns < self._retry_ns:
            raise OSError(0, self.problem)
        self._number += 1
        path = self._folder / str(FileName(self._started, self._server, self._number))
        while path.exists():  # another recorder of this server, started in the same second, wrote that file
            self._number += 1
            path = self._folder / str(FileName(self._started, self._server, self._number))
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW
        self._fd, self._path = os.open(path, flags, _FILE_MODE), path
        fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        file = McapFile(self._fd)
        try:
            metadata = {**self._metadata, "number": str(self._number)}
            file.begin(PROFILE, self._library, {METADATA_NAME: metadata})
        except OSError:
            path.unlink(missing_ok=True)
            raise
        self._file = file
        self.problem = ""
        self._prune(now_ns)
        return file

    def _fail(self, error: OSError, now_ns: int) -> None:
        """Close the file unfinished, count its unwritten messages as dropped, and allow a new file in 5 s."""
        self.dropped += max(1, self._waiting)
        self._waiting = 0
        if now_ns >= self._retry_ns:
            self.problem = error.strerror or str(error)
            self._retry_ns = now_ns + _RETRY_INTERVAL_NS
        self._file = None
        self._close_descriptor()

    def _close_descriptor(self) -> None:
        self._numbers.clear()
        self._path = None
        if self._fd >= 0:
            with suppress(OSError):  # closing fails if the disk was removed
                os.close(self._fd)
            self._fd = -1

    def _prune(self, now_ns: int) -> None:
        """Delete the oldest recordings that no process writes, until at most ``max_bytes`` remain."""
        self._pruned_ns = now_ns
        recordings = []
        for path in self._folder.glob(f"*{SUFFIX}"):
            name = FileName.parse(path.name)
            with suppress(OSError):
                if name is not None and not path.is_symlink():
                    recordings.append((name.started, name.number, path.stat().st_size, path))
        total = sum(size for _, _, size, _ in recordings)
        for _, _, size, path in sorted(recordings):
            if total <= self._max_bytes:
                return
            if path != self._path and _delete_unlocked(path):
                total -= size


def _delete_unlocked(path: Path) -> bool:
    """Delete the file *path* unless a process has locked it; return whether it was deleted."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        path.unlink()
    except OSError:
        return False
    finally:
        os.close(fd)
    return True
