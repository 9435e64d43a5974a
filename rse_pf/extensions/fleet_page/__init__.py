"""The fleet page: one look at a running platform, in a browser on this machine, from a process of its own.

The process reads what the control plane tells its operator, the logs, and live maps; it passes all of it on
to browsers by server-sent events.  Robots and servers notice nothing of it, and nothing depends on it.
"""
