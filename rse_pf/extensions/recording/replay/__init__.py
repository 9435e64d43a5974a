"""Replay of recorded commands: solve them again, compare the answers byte by byte, and report them.

Recordings are written and read by `rse_pf.extensions.recording`.
"""
