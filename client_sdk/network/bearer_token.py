"""Check the text of a token before it is sent in a header; a text that cannot be a token is never shown.

Only the server decides whether the token is valid.
"""

from __future__ import annotations

import re

from rse_pf.errors import Unauthorized

__all__ = ["strip_token"]

PRINTABLE_ASCII = re.compile(r"[!-~]+")
"""Characters that the HTTP header Authorization can hold behind the word Bearer."""
USAGE_HINT = (
    "pass the text that rse-pf token issue ROBOT prints, or a function that returns it: an async one to "
    "connect, a plain one to DataClient (client_sdk.enrolment.read_enrolment returns both)"
)


def strip_token(token: object) -> str:
    """Return *token* without the white space around it, which files and shells add.

    Raises:
        Unauthorized: *token* is not a text, is empty, or has characters that an HTTP header cannot hold.
    """
    if not isinstance(token, str):
        raise Unauthorized(f"the token is a {type(token).__name__}, not a text", hint=USAGE_HINT)
    text = token.strip()
    if not text:
        raise Unauthorized("the token is empty", hint=USAGE_HINT)
    if not PRINTABLE_ASCII.fullmatch(text):
        raise Unauthorized(
            f"the token has {len(text)} characters, and some of them are in no token: a space, a line break "
            "or a character outside of ASCII",
            hint=USAGE_HINT,
        )
    return text
