"""The audit log: a hash chain of entries, its files, and the check that nobody changed them.

What is recorded is decided by the caller; this package only writes, chains and verifies.
"""
