"""Fetch the public keys with which the servers verify the robots' tokens."""

from __future__ import annotations

from rse_pf.auth.tokens import KeySet
from rse_pf.aws.fleet.task import AgentContext, Task
from rse_pf.aws.fleet.tasks.fetch import fetch
from rse_pf.storage.files import replace_file

__all__ = ["task"]

_NO_KEYS = "no keys in the bucket yet, so robots are refused; run rse-pf token init --cloud"


def task(context: AgentContext) -> Task:
    """Return the task that writes the public keys to a file of the server if they changed in the bucket.

    If the key set in the bucket is invalid or missing, the file stays as it is.  If there is no file either,
    an empty key set is written, with which the server refuses all robots.
    """

    def fetch_keys() -> None:
        file = context.config.keys_file
        exists = fetch(
            context,
            context.config.keys_name,
            file,
            lambda data: KeySet.from_json(data.decode("utf-8", "replace")),
        )
        if not exists and not file.exists():
            replace_file(file, b'{"keys":[]}\n')
            context.log("no-keys", hint=_NO_KEYS)

    return Task(name="keys", period_s=context.settings.scaling.period_s, call=fetch_keys)
