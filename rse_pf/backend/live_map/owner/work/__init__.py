"""What works beside the requests of an owner: its threads, the writer of its log, measuring and publishing.

What a request means belongs to `LiveOwner`, and the map itself to `MapState`.
"""
