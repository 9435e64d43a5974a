"""Limited services: commands that are computed in processes with limits on memory and CPU time.

Their processes, and the robots that are refused after crashes, belong here.  How a process is limited and
killed belongs to `rse_pf.processes.limited`; their queue to `rse_pf.server.gateway.service_queues`.
"""
