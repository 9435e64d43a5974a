"""Who a robot is and what it may do: tokens, the roster of robots, keys, and the store that servers trust.

The rules and the files of identity belong here; sockets and HTTP replies do not.
"""
