"""Transfer of large data over HTTP: objects and maps, resumed and background uploads, presigned addresses.

Commands travel on the WebSocket of `client_sdk.network.connection` instead.
"""
