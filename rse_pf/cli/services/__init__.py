"""The verb service: create, build, lock, test, install, publish and unblock services of your own.

Options and printed text belong here; how a service is run belongs to `rse_pf.services.custom`.
"""
