"""Record the events of a local platform and the samples of its monitor.

The recorder also creates the key of the pseudonyms, which all servers of a recording use, and deletes it at
the end.  A full disk neither delays nor stops the platform.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from rse_pf.config import PlatformSettings
from rse_pf.extensions.recording.file_format import EVENT_SCHEMA, EVENTS_TOPIC, SAMPLE_SCHEMA, SAMPLES_TOPIC
from rse_pf.extensions.recording.writer import RecordingWriter
from rse_pf.local.state import recording_key_file
from rse_pf.storage.files import create_private_file

__all__ = ["FilePlatformRecorder", "make_platform_recorder"]

_CONTROL_PLANE = "control-plane"  # name of the server in the names of the files
_KEY_BYTES = 32  # random bytes of the key of the pseudonyms, which its file holds as hex digits
_UNRECORDED_FIELDS = ("robot", "robots_named", "tenant", "token", "url")
"""Fields of events that are not recorded, since they may hold a name, a secret or an address."""


def make_platform_recorder(settings: PlatformSettings, state: Path) -> FilePlatformRecorder | None:
    """Return the recorder of the platform in the folder *state*; None if no folder for recordings is set."""
    return FilePlatformRecorder(settings, state) if settings.recording.folder else None


class FilePlatformRecorder:
    """Record one platform in files; implements `rse_pf.local.control.platform_recorder.PlatformRecorder`."""

    def __init__(
        self, settings: PlatformSettings, state: Path, time_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self._recording = settings.recording
        self._key = recording_key_file(state.absolute())
        self._time_ns = time_ns
        self._writer: RecordingWriter | None = None

    def begin(self) -> None:
        """Create the key of the pseudonyms unless an earlier control plane left one; prepare the file."""
        recording = self._recording
        with suppress(FileExistsError):
            create_private_file(self._key, secrets.token_hex(_KEY_BYTES))
        self._writer = RecordingWriter(
            Path(recording.folder), _CONTROL_PLANE, started_ns=self._time_ns(),
            max_bytes=recording.max_bytes,
            metadata={"side": "platform"},
        )  # fmt: skip

    def record_sample(self, sample: Mapping[str, Any]) -> None:
        """Record one sample of the monitor."""
        self._write(SAMPLES_TOPIC, SAMPLE_SCHEMA, dict(sample))

    def record_event(self, event: Mapping[str, Any]) -> None:
        """Record one event of the platform without the fields that may hold names, secrets or addresses."""
        details = {name: value for name, value in event.items() if name not in (*_UNRECORDED_FIELDS, "event")}
        self._write(EVENTS_TOPIC, EVENT_SCHEMA, {"kind": event["event"], **details})

    def close(self) -> None:
        """Finish the file, and delete the key of the pseudonyms."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
            with suppress(OSError):
                self._key.unlink(missing_ok=True)

    def _write(self, topic: str, schema: str, value: dict[str, Any]) -> None:
        writer = self._writer
        if writer is not None:
            now_ns = self._time_ns()
            writer.add_json(topic, schema, now_ns, {"time_s": now_ns / 1e9, **value})
            writer.flush(now_ns)
