"""Fault injection: kill, pause, slow down or cut off a server, let a store fail, and emulate a network link.

Only experiments and the commands of ``rse-pf local`` that inject faults use this package.
"""
