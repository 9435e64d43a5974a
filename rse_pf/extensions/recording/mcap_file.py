"""Write an MCAP file in chunks: a file that was not finished can be read up to its last complete chunk.

Records that are rare are encoded by the library `mcap`.  Messages, chunks and their indexes are packed here,
which takes 2 microseconds for a message; the writer of the library takes 20 to 30.

Source:
    MCAP specification, version 0 (mcap.dev/spec).
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import Counter
from collections.abc import Mapping
from typing import Any

__all__ = ["MAX_CHUNK_BYTES", "MAX_CHUNK_NS", "McapFile"]

MAX_CHUNK_BYTES = 1 << 20  # size in bytes at which a chunk is written to the file
MAX_CHUNK_NS = 500_000_000  # age, ns, of the first message of a chunk at which the chunk is written
_MAGIC = b"\x89MCAP0\r\n"  # first and last bytes of an MCAP file
# A message record: opcode, length, channel, sequence number, log time and publish time (ns); the data
# follows.
_MESSAGE = struct.Struct("<BQHIQQ")
# Size of a message record without its data.
_MESSAGE_BYTES = _MESSAGE.size
_MESSAGE_FIELDS = _MESSAGE_BYTES - 9  # size of the fields of a chunk record without opcode (1) and length (8)
_pack_message = _MESSAGE.pack
# A chunk record: opcode, length, first and last time (ns), uncompressed size, CRC, length of the name of the
# compression, size of the records that follow.  Chunks are not compressed: the name is empty, its length 0.
_CHUNK = struct.Struct("<BQQQQIIQ")
_CHUNK_FIELDS = _CHUNK.size - 9  # bytes of its fields without opcode (1) and length (8)
# A message index record: opcode, length, channel, size of the pairs of time and offset that follow.
_INDEX = struct.Struct("<BQHI")
# Start of a chunk index record: opcode, length, first and last time (ns), offset and size of the chunk, size
# of the message index offsets that follow.
_CHUNK_INDEX = struct.Struct("<BQQQQQI")
# End of a chunk index record, after its message index offsets: size of the message indexes, length of the
# name of the compression (0, so that no name follows), compressed and uncompressed size (the same).
_CHUNK_INDEX_END = struct.Struct("<QIQQ")
_OFFSET = struct.Struct("<HQ")  # one message index offset: channel, offset of the index in the file
_OP_MESSAGE = 5  # opcode of a message record in the MCAP specification
_OP_CHUNK = 6  # opcode of a chunk record
_OP_INDEX = 7  # opcode of a message index record
_OP_CHUNK_INDEX = 8  # opcode of a chunk index record


class McapFile:
    """Write one MCAP file to a file descriptor: `begin`, then add channels and messages, then `finish`.

    A message is kept in memory until its chunk is written to the file, see `flush`.  A write that fails
    raises OSError, and truncates the file to the last complete chunk, so that it stays readable.
    """

    def __init__(self, fd: int) -> None:
        """Take the descriptor *fd* of an empty file, which the caller closes; nothing is written yet."""
        self.size_bytes = 0
        self._fd = fd
        self._parts: list[bytes] = []
        self._chunk_bytes = 0
        self._first_ns = 0
        self._offsets: dict[int, list[int]] = {}
        self._chunk_indexes: list[bytes] = []
        self._schemas: dict[str, Any] = {}
        self._channels: list[Any] = []
        self._counts: Counter[int] = Counter()
        self._metadata_index: list[bytes] = []
        self._span: tuple[int, int] | None = None

    def begin(
        self, profile: str, library: str, metadata: Mapping[str, Mapping[str, str]] | None = None
    ) -> None:
        """Write the header, and a metadata record for each entry of *metadata*."""
        from mcap.records import Header, Metadata, MetadataIndex

        self._write(_MAGIC + _record(Header(profile=profile, library=library)))
        for name, values in (metadata or {}).items():
            data = _record(Metadata(name=name, metadata=dict(values)))
            self._metadata_index.append(
                _record(MetadataIndex(offset=self.size_bytes, length=len(data), name=name))
            )
            self._write(data)

    def channel(
        self,
        topic: str,
        encoding: str,
        schema: tuple[str, str, bytes] | None = None,
        metadata: Mapping[str, str] | None = None,
    ) -> int:
        """Add a channel, and return its number for `add`.

        *schema* is the name, the encoding and the data of its schema; None if it has none.
        """
        from mcap.records import Channel, Schema

        number = 0
        if schema is not None:
            name, kind, data = schema
            if name not in self._schemas:
                self._schemas[name] = Schema(id=len(self._schemas) + 1, name=name, encoding=kind, data=data)
                self._add_part(_record(self._schemas[name]))
            number = self._schemas[name].id
        channel = Channel(
            id=len(self._channels) + 1, topic=topic, message_encoding=encoding, schema_id=number,
            metadata=dict(metadata or {}),
        )  # fmt: skip
        self._channels.append(channel)
        self._add_part(_record(channel))
        return len(self._channels)

    @property
    def channels(self) -> int:
        """Number of the channels of the file."""
        return len(self._channels)

    def add(self, channel: int, time_ns: int, data: bytes) -> None:
        """Add a message to the chunk, and write the chunk once it has 1 MiB; raises OSError.

        *time_ns* is the Unix time of the message, ns.
        """
        offsets = self._offsets.get(channel)
        if offsets is None:
            if not self._offsets:
                self._first_ns = time_ns
            offsets = self._offsets[channel] = []
        number = self._counts[channel] + len(offsets) // 2
        at, size = self._chunk_bytes, len(data)
        offsets += (time_ns, at)
        self._parts += (
            _pack_message(
                _OP_MESSAGE, _MESSAGE_FIELDS + size, channel, number & 0xFFFFFFFF, time_ns, time_ns
            ),
            data,
        )
        self._chunk_bytes = at = at + _MESSAGE_BYTES + size
        if at >= MAX_CHUNK_BYTES:
            self.flush()

    def is_due(self, now_ns: int) -> bool:
        """Return whether the chunk is to be flushed: its first message is 0.5 s old at *now_ns*."""
        return bool(self._offsets) and now_ns - self._first_ns >= MAX_CHUNK_NS

    def flush(self) -> None:
        """Write the waiting messages as a chunk with its indexes; nothing without messages.

        Raises OSError if the write fails; the messages of the chunk are then lost.
        """
        if not self._offsets:
            return
        records = b"".join(self._parts)
        span = (
            min(min(offsets[::2]) for offsets in self._offsets.values()),
            max(max(offsets[::2]) for offsets in self._offsets.values()),
        )
        chunk = _CHUNK.pack(
            _OP_CHUNK, _CHUNK_FIELDS + len(records), *span, len(records), zlib.crc32(records), 0, len(records)
        )
        chunk_bytes = len(chunk) + len(records)
        places: list[bytes] = []
        indexes: list[bytes] = []
        index_bytes = 0
        for channel, offsets in self._offsets.items():
            places.append(_OFFSET.pack(channel, self.size_bytes + chunk_bytes + index_bytes))
            self._counts[channel] += len(offsets) // 2
            index = struct.pack(f"<{len(offsets)}Q", *offsets)
            indexes += (_INDEX.pack(_OP_INDEX, 6 + len(index), channel, len(index)), index)
            index_bytes += _INDEX.size + len(index)
        start = self.size_bytes
        self._clear_chunk()
        self._write(b"".join((chunk, records, *indexes)))
        entries = b"".join(places)
        end = _CHUNK_INDEX_END.pack(index_bytes, 0, len(records), len(records))
        self._chunk_indexes.append(
            _CHUNK_INDEX.pack(
                _OP_CHUNK_INDEX, _CHUNK_INDEX.size - 9 + len(entries) + len(end), *span, start, chunk_bytes,
                len(entries),
            ) + entries + end
        )  # fmt: skip
        before = self._span or span
        self._span = min(before[0], span[0]), max(before[1], span[1])

    def finish(self) -> None:
        """Write the waiting messages and the summary, with which readers find any message; raises OSError."""
        from mcap.records import DataEnd, Footer, Statistics

        self.flush()
        self._write(_record(DataEnd(data_section_crc=0)))
        start = self.size_bytes
        first_ns, last_ns = self._span or (0, 0)
        statistics = Statistics(
            message_count=sum(self._counts.values()), schema_count=len(self._schemas),
            channel_count=len(self._channels), attachment_count=0, metadata_count=len(self._metadata_index),
            chunk_count=len(self._chunk_indexes), message_start_time=first_ns, message_end_time=last_ns,
            channel_message_counts=dict(self._counts),
        )  # fmt: skip
        described = [_record(record) for record in (*self._schemas.values(), *self._channels, statistics)]
        summary = b"".join((*described, *self._chunk_indexes, *self._metadata_index))
        checked = summary + struct.pack("<BQQQ", 2, 20, start, 0)
        footer = Footer(summary_start=start, summary_offset_start=0, summary_crc=zlib.crc32(checked))
        self._write(summary + _record(footer) + _MAGIC)

    def _add_part(self, data: bytes) -> None:
        self._parts.append(data)
        self._chunk_bytes += len(data)

    def _clear_chunk(self) -> None:
        self._parts, self._offsets, self._chunk_bytes = [], {}, 0

    def _write(self, data: bytes) -> None:
        """Append *data* to the file, or truncate the file to its former size and raise OSError."""
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._fd, rest) :]
        except OSError:
            os.ftruncate(self._fd, self.size_bytes)
            os.lseek(self._fd, self.size_bytes, os.SEEK_SET)
            raise
        self.size_bytes += len(data)


def _record(record: Any) -> bytes:
    """Encode a record object of the library `mcap`."""
    from mcap.data_stream import RecordBuilder

    builder: Any = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()
    return data
