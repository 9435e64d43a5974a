"""A robot's connection: which platform, when to dial, and the WebSocket."""
