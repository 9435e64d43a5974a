"""The command line of the platform: one module for each verb of the core; `rse_pf.cli.main` lists all verbs.

Options and printed text belong here; what a verb does belongs in the package it calls.
"""
