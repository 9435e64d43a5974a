"""Replay of recorded commands: solve them again, compare, explain, report and export them."""
