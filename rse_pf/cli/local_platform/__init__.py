"""The verbs local and fleet: start a platform on this machine, show it and change it while it runs.

What a person reads and types belongs here; what it does is in `rse_pf.local`.
"""
