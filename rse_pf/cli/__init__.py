"""The command line of the platform, one module for each verb; `rse_pf.cli.main` names its folder.

Options and printed text belong here; what a verb does belongs in the package it calls.
"""
