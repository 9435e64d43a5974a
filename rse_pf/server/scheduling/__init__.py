"""Which command runs next, and in which thread.

Queues and executors belong here; what a command does, and its answer on the wire, do not.
"""
