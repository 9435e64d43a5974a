"""The verb cloud: one module for each action, listed in `rse_pf.cli.cloud.cloud`.

Options and printed text belong here; the work is in `rse_pf.aws`.
"""
