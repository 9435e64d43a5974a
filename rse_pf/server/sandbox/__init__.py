"""Sandboxes: isolated processes that run installed services, one process for each robot.

How these processes are isolated, supervised and exchange messages with their worker belongs here; reading the
folder of an installed service belongs to `rse_pf.services.custom`.
"""
