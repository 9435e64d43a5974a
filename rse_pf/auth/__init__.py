"""Who a robot is and what it may do: tokens, the roster of robots, keys and the store that servers trust.

Rules and files of identity belong here; sockets and HTTP answers do not.
"""
