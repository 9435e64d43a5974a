"""Replay of recorded commands: solve them again, compare to the byte, report and export them.

Writing a recording belongs to `rse_pf.extensions.recording`.
"""
