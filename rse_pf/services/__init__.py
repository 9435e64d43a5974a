"""Services: functions from one typed request to one typed reply.

Algorithms that robots call belong here; transport, scheduling and isolation do not.
"""
