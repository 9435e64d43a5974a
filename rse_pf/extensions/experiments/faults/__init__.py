"""Faults of experiments: a store whose writes fail, and an emulated network link.

Faults of the servers of a platform are injected by `rse_pf.local.faults`.
"""
