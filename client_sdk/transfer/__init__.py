"""Large data over HTTP: objects up and down, uploads in the background, presigned addresses.

HTTP with a data server belongs here; commands on the WebSocket belong to `client_sdk.network.connection`.
"""

from client_sdk.transfer.background_upload import BackgroundUploader
from client_sdk.transfer.data_client import DataClient, DataOptions, OnBytes

__all__ = ["BackgroundUploader", "DataClient", "DataOptions", "OnBytes"]
