"""The verb service: write, build, lock, replay, install and unblock services of your own.

How a service is run belongs to `rse_pf.services.custom`.
"""
