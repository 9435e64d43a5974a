"""Recordings of what robots and servers said: MCAP files, how they are written and read.

Decoding in the path of a command does not belong here, nor do sockets of robots.
"""
