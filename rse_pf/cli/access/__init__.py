"""The verbs robot, token, tenant and audit: who may connect and store what, and the log of what was done.

Options and printed text belong here; the work is in `rse_pf.auth` and `rse_pf.audit`.
"""
