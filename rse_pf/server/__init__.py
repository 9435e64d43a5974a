"""A backend server: one supervisor process, and worker processes that hold the connections of robots.

The packages are the supervisor, the gateway, scheduling, limited services (`compute`), jobs, sandboxes and
live maps.  The modules in this folder are used by several of them: the values that the parts of a worker
share, log, metrics, storage within quotas, and references to stored objects.  The entry point is
`rse_pf.server.supervisor.serve`.
"""
