"""The fleet page: a web page on this machine that shows a running platform, served by a process of its own.

The process reads the operator's port of the control plane, the logs and the live maps, and sends their
content to browsers as server-sent events.  Robots and servers are not affected by it, and nothing depends on
it.
"""
