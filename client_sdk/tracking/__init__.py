"""How a camera is tracked: the maps of its keyframes, and the order in which a frame is matched.

`client_sdk.tracking.tracker` is for a camera with depth, `client_sdk.tracking.monocular_tracker` for one
without.  Cameras and files are elsewhere, and so is who solves the poses.
"""
