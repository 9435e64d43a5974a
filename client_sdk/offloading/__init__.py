"""Decide where a command is computed, and ask there: a server, the burst function, or the robot itself.

The burst function is the platform's AWS Lambda function, which answers pose commands while no server can.
WebSockets belong to `client_sdk.network`.
"""
