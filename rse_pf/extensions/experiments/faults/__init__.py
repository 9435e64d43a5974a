"""Faults on purpose: kill, pause or slow a server, and emulate a network link.

Only what experiments and `rse-pf local` inject belongs here; nothing else imports this package at run time.
"""
