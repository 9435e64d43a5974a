"""The verb cloud: one module for each action, listed in `rse_pf.cli.cloud.cloud`.

What a person reads and types belongs here; the work is in `rse_pf.aws`.
"""
