"""The codecs of servers and of the Lambda function, which inflate short messages with isal, not with zlib.

isal, a faster implementation of zlib, is not installed on robots.
"""

from __future__ import annotations

from rse_pf.config import SessionSettings
from rse_pf.errors import MissingExtra
from rse_pf.wire.codec import Codec, ReadFirst, make_codec

__all__ = ["make_server_codec"]


def make_server_codec(
    name: str, limits: SessionSettings | None = None, *, read_first: ReadFirst | None = None
) -> Codec:
    """Return the codec *name* as servers use it.

    Args:
        name: ``zlib``, ``json`` or ``bin``.
        limits: Limits of robots' messages; None means the defaults.
        read_first: Reads the commands of one service at less cost than the codec, see `ReadFirst`; None if
            there is no such function.

    Raises:
        UnsupportedProtocol: There is no such codec.
        MissingExtra: isal is not installed.
    """
    try:
        from isal import isal_zlib
    except ImportError as error:
        raise MissingExtra("isal", "backend") from error
    return make_codec(name, limits, zlib_library=isal_zlib, read_first=read_first)
