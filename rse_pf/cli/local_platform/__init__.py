"""The verb local: start a platform on this machine, show its state, and change it while it runs.

Options and printed text belong here; the work is in `rse_pf.local`.
"""
