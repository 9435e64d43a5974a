"""Modules that the verbs of the command line share, those of `rse_pf.cli` and those of extensions.

`options` turns the words of a command into a typed request; `extras` lists the packages that each verb needs.
"""
