"""Limited services: services that a worker runs in processes with limits on memory and CPU time.

A service is limited if it decodes data that may expand to any size, such as a map.  This package has the
code of these processes, and refuses robots whose commands crashed them.  `rse_pf.processes.limited` sets the
limits and kills a process; `rse_pf.server.gateway.service_queues.LimitedQueue` has the commands that wait.
"""
