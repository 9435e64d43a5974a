"""Isolated processes for installed services, one for each robot.

Isolation, supervision and IPC of these processes belong here; reading a service folder does not.
"""
