"""The control plane on one machine: monitor, scale modifier, rebalancer, status.

Loops that observe servers and decide about them belong here; how a process is started belongs to `servers`.
"""
