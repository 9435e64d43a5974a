"""The audit log: append-only files of JSON lines that record who did what and when.

This package limits the size of entries, writes them to files and reads them.  Which actions are recorded is
decided by the callers.
"""
