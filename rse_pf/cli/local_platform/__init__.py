"""The actions of the verb local that show or change a platform that runs: logs, robots, drain, roll, LAN.

What a person reads and types belongs here; what it does is in `rse_pf.local`.
"""
