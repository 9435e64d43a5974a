"""What verbs of the command line share, those of `rse_pf.cli` and those of extensions.

`options` makes typed requests of what was typed; `extras` knows which packages a verb needs.
"""
