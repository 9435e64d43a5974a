"""Start, limit and stop child processes of the platform, and exchange messages with them.

A child is a new Python interpreter that runs one function and has one socket to its parent.  Servers, which
may outlive the program that started them, are started by `rse_pf.local.processes`; the workers of a server
are forked from its supervisor.
"""
