"""Replay of recorded commands: solve them again, compare to the byte, explain, report and export them.

Writing a recording belongs to `rse_pf.recording`, and why a pose is bad to `rse_pf.recording.explain`.
"""
