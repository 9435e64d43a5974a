"""A backend server, in packages from the supervisor and the gateway to sandboxes, jobs and live maps.

Here is what they share: ports, log, metrics, quota and references to stored objects. The entry is
`rse_pf.server.supervisor.serve`.
"""
