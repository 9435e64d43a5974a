"""Merge maps that are too large for one process: several processes compute the parts of a merge.

The name of a part is a hash of its inputs and arguments, and its result is stored under this name.  Every
process computes the same result for a part, and a part whose result is stored is never computed again, also
after a process was killed.  Long commands of robots are not parts; they belong to `rse_pf.server.jobs`.
"""
