"""Start, limit and stop child processes of the platform, and exchange messages with them.

A child is a new interpreter that runs one function and has one socket to its parent.  Servers, which may
outlive what started them, are `rse_pf.local.processes`; workers are forked from their supervisor.
"""
