"""A backend server, in packages from the supervisor and the gateway to sandboxes, jobs and live maps.

The modules here are shared by these packages: values of a worker, log, metrics, quotas, and references to
stored objects.  The entry point is `rse_pf.server.supervisor.serve`.
"""
