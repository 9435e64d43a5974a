"""Verify the audit logs in a folder: every chain is complete, its own, and holds the heads kept elsewhere.

Nothing is changed.  A verdict names in one sentence the file and the first entry that is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rse_pf.audit import heads
from rse_pf.audit.chain import CONTINUED, GENESIS, HEADS, HEADS_LOST, Chain, Entry, Head, parse_head
from rse_pf.audit.log import chain_names, files_of, lines_of

__all__ = ["Verdict", "check_chain", "check_folder", "entries_of"]

_NO_HEADS = "the file is missing: it was removed, or RSE-PF 0.1.0 wrote these logs and nothing later"


@dataclass(slots=True, kw_only=True)
class Verdict:
    """The result for one chain; ``problem`` is empty if it is intact.

    ``claims`` are the heads that this chain recorded, with the number of the entry; ``writer`` is who wrote
    its first entry.
    """

    who: str
    writer: str = ""
    entries: int = 0
    head: Head = GENESIS
    file: str = ""
    problem: str = ""
    notes: list[str] = field(default_factory=list)
    hashes: dict[int, str] = field(default_factory=dict)
    claims: list[tuple[str, Head, int]] = field(default_factory=list)

    @property
    def first(self) -> str:
        """Hash of the first entry, "" without entries."""
        return next(iter(self.hashes.values()), "")


def check_chain(who: str, files: Sequence[Path], *, from_genesis: bool = True) -> Verdict:
    """Verify the chain in *files*, oldest first, up to its first wrong entry.

    Args:
        who: Its name.
        files: In the order of `files_of`.
        from_genesis: Whether the chain must begin with entry 1.
    """
    verdict = Verdict(who=who)
    chain = Chain(GENESIS if from_genesis else None)
    is_torn = False
    for path in files:
        verdict.file = path.name
        for line in lines_of(path):
            if not line.endswith(b"\n"):
                verdict.notes.append(
                    f"{path.name} ended in the middle of a line, {verdict.entries} whole entries good"
                )
                is_torn = True
                break
            entry = chain.add(line)
            if isinstance(entry, str):
                verdict.problem = entry
                return verdict
            if is_torn and (entry.action, entry.detail.get("reason")) != (CONTINUED, "torn"):
                verdict.problem = f"entry {entry.seq} does not say that the file before it was torn"
                return verdict
            is_torn = False
            _count(verdict, entry)
    if is_torn:
        verdict.problem = f"ended in the middle of a line, {verdict.entries} whole entries good"
    return verdict


def check_folder(folder: Path, *, known: Mapping[str, Head] | None = None) -> list[Verdict]:
    """Return a verdict for each chain in *folder*, and one for the file of heads if that is wrong.

    Named are changed, moved and removed entries, a removed end, a removed log, and a copy of a log.

    Args:
        folder: Folder of the logs.
        known: Heads that were stored elsewhere, by name of the chain.

    Raises:
        OSError: A file cannot be read.
    """
    recorded = heads.read_heads(folder)  # before the logs, which may grow meanwhile
    verdicts = {who: check_chain(who, files_of(folder, who)) for who in chain_names(folder)}
    lines, problems = ({}, [_NO_HEADS]) if recorded is None else recorded
    _find_added(verdicts, lines, has_heads=recorded is not None)
    claims = [
        (name, head, f"entry {seq} of {teller.who}")
        for teller in verdicts.values()
        for name, head, seq in teller.claims
    ]
    claims += [(name, head, "the file of heads") for name, head in lines.items() if head.seq]
    claims += [(name, head, "the head stored elsewhere") for name, head in (known or {}).items()]
    for name, head, teller in claims:
        verdict = verdicts.setdefault(name, Verdict(who=name, file=f"{name}.jsonl"))
        if not verdict.problem and verdict.hashes.get(head.seq) != head.hash:
            verdict.problem = _contradiction(verdict, head, teller)
    checked = [verdicts[name] for name in sorted(verdicts)]
    return checked + [Verdict(who="heads", file=heads.FILE, problem=problem) for problem in problems[:1]]


def _find_added(verdicts: Mapping[str, Verdict], lines: Mapping[str, Head], *, has_heads: bool) -> None:
    """Name the chains that are a copy of another one, or that no writer has announced."""
    own = {
        first: verdict.who
        for verdict in verdicts.values()
        if (first := verdict.first) and verdict.writer == verdict.who
    }
    for verdict in verdicts.values():
        owner = own.get(verdict.first, verdict.who)
        if owner != verdict.who:
            verdict.problem = f"the log was added: its entries are a copy of those of {owner}"
        elif has_heads and verdict.who not in lines and not verdict.problem:
            verdict.problem = "the log was added: it has no line in the file of heads"


def _contradiction(verdict: Verdict, head: Head, teller: str) -> str:
    if not verdict.entries:
        return f"the log is missing: {teller} has seen entry {head.seq}"
    if head.seq in verdict.hashes:
        return f"entry {head.seq} was changed: {teller} names another"
    return f"entry {head.seq} is missing: {teller} has seen it"


def entries_of(files: Sequence[Path]) -> Iterator[Entry]:
    """Yield the readable entries, also of a broken chain."""
    for path in files:
        for line in lines_of(path):
            entry = Chain(None).add(line)
            if isinstance(entry, Entry):
                yield entry


def _count(verdict: Verdict, entry: Entry) -> None:
    if verdict.entries == 0 and entry.seq > 1:
        verdict.notes.append(f"begins with entry {entry.seq}; earlier ones are not checked")
    if verdict.entries == 0:
        verdict.writer = entry.actor
    if entry.action == HEADS_LOST:
        verdict.notes.append(f"entry {entry.seq} made the file of heads, which was missing")
    verdict.entries += 1
    verdict.head = entry.head
    verdict.hashes[entry.seq] = entry.hash
    if entry.action == HEADS:
        for name, word in entry.detail.items():
            head = parse_head(word) if isinstance(word, str) else None
            if head is not None:
                verdict.claims.append((name, head, entry.seq))
