"""Trackers: the pose of a camera for each frame, and the map of keyframes and landmarks behind the poses.

`client_sdk.tracking.tracker` is for cameras with depth and stereo pairs,
`client_sdk.tracking.monocular_tracker` for one lens without depth.  Neither reads cameras or files, and
neither solves a pose: both return pose queries.
"""
