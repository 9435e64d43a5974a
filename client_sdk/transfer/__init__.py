"""Large data over HTTP: objects up and down, uploads in the background, presigned addresses.

HTTP with a data server belongs here; commands on the WebSocket belong to `client_sdk.connection`.
"""
