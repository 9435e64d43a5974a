"""The audit log: append-only files of JSON lines, one log for each writing process.

What is recorded is decided by the caller; this package bounds, writes and reads entries.
"""
