"""The text of a token, checked before it is sent; a text that cannot be a token is never shown.

Whether the token is valid is judged by the server alone.
"""

from __future__ import annotations

import re

from rse_pf.errors import Unauthorized

__all__ = ["strip_token"]

_TOKEN = re.compile(r"[!-~]+")
_HINT = (
    "pass the text that rse-pf token issue ROBOT prints, or a function that returns it: an async one to "
    "connect, a plain one to DataClient (client_sdk.enrolment.read_enrolment returns both)"
)


def strip_token(token: object) -> str:
    """Return *token* without the white space around it, which files and shells add.

    Raises:
        Unauthorized: It is not a text, is empty, or has letters that no header can hold.
    """
    if not isinstance(token, str):
        raise Unauthorized(f"the token is a {type(token).__name__}, not a text", hint=_HINT)
    text = token.strip()
    if not text:
        raise Unauthorized("the token is empty", hint=_HINT)
    if not _TOKEN.fullmatch(text):
        raise Unauthorized(
            f"the token has {len(text)} letters, and some of them are in no token: a space, a line break or "
            "a letter outside of ASCII",
            hint=_HINT,
        )
    return text
