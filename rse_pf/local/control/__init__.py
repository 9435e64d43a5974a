"""The control plane on one machine: monitor, scale modifier, rebalancer, status.

Loops that observe and decide belong here; starting a process belongs to `servers`.
"""
