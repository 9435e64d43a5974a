"""How a camera with depth is tracked: the map of its keyframes, and the order in which a frame is matched.

Cameras and files are elsewhere, and so is who solves the poses.  A camera without depth is tracked by
`client_sdk.tracking.monocular_tracker`.
"""
