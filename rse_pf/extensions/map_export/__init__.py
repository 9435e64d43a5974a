"""Write stored maps in the formats of other programs: ``rse-pf map export``.

This package is an extension: it imports the core of `rse_pf`, and only the command line imports it.
"""
