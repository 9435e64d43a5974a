"""The codecs of servers and of the Lambda: those of robots, with isal in place of zlib for short messages."""

from __future__ import annotations

from rse_pf.config import SessionSettings
from rse_pf.errors import MissingExtra
from rse_pf.wire.codec import Codec, ReadFirst, make_codec

__all__ = ["make_server_codec"]


def make_server_codec(
    name: str, limits: SessionSettings | None = None, *, read_first: ReadFirst | None = None
) -> Codec:
    """Return the codec called *name* of a server.

    Args:
        name: ``zlib``, ``json`` or ``bin``.
        limits: What is accepted from robots.
        read_first: Reads the inflated messages of one service at less cost; None for what it does not read.

    Raises:
        UnsupportedProtocol: There is no such codec.
        MissingExtra: isal is not installed.
    """
    try:
        from isal import isal_zlib
    except ImportError as error:
        raise MissingExtra("isal", "backend") from error
    return make_codec(name, limits, zlib_library=isal_zlib, read_first=read_first)
