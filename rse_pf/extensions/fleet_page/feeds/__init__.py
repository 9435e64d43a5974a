"""The feeds of the page: they read the control plane, servers, logs, live maps or AWS, and fill the hub.

Requests of browsers are handled in the package above.
"""
