"""Connections of a robot: which platform it dials, when it dials, the handshake, and the WebSocket.

What commands and subscriptions return is defined in `client_sdk.commands`; `client_sdk.offloading` decides
whether a server, the burst function (AWS Lambda) or the robot itself computes a command.
"""
