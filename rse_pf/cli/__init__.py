"""The command line of the platform: one module for each verb of the core; `rse_pf.cli.main` lists all verbs.

Options and printed text belong here; the work of a verb belongs in the package that it calls.
"""
