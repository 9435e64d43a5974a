"""The order in which commands are computed, and the event loop and threads that share the work.

Schedulers and queues belong here; the computation of a command, and its answer on the wire, do not.
"""
