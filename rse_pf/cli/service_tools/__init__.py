"""What the verb service does for the authors of services: build, lock, record, replay and debug.

The options of the verb belong to `rse_pf.cli.service`; how a service is run belongs to
`rse_pf.services.custom`.
"""
