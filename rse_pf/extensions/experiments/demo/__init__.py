"""The demo: robots build maps through a platform on this machine.

Its robots, keyframes, merge and report belong here; error measures belong to `results`.
"""
