"""Limited services: commands that are computed in processes with a memory limit, beside the solver threads.

Their queue, their processes and the robots that are kept from them belong here; how a process is limited and
killed belongs to `rse_pf.processes.limited`.
"""
