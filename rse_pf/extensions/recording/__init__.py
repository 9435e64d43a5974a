"""Recordings of the messages between robots and servers as MCAP files: format, writing and reading.

Connections with robots, and the decoding of the commands that a server answers, are in `rse_pf.server`.
"""
