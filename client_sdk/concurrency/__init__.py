"""Threads, tasks and callbacks: the event loop of a blocking robot, and guarded calls of user functions.

Nothing in this package knows the network or the protocol.
"""
