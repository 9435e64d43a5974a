"""The verbs robot, token and audit: who may connect, and what was done.

What a person reads and types belongs here; the work is in `rse_pf.auth` and `rse_pf.audit`.
"""
