"""A robot's connection: which platform, when to dial, the handshake, and the WebSocket.

What is said on it belongs to `client_sdk.answers` and `client_sdk.updates`, who computes to
`client_sdk.offloading`.
"""
