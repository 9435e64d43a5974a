"""A backend server, in packages: supervisor, gateway, scheduling, sandbox and jobs.

Here is what they share: ports, log, metrics, quota and references to stored objects. The entry is
`rse_pf.backend.supervisor.serve`.
"""
