"""Decide who computes a command, and ask them: a backend server, the burst function, or the robot itself.

The burst function is the platform's AWS Lambda, which answers pose commands while no server can.  WebSockets
belong to `client_sdk.network`.
"""
