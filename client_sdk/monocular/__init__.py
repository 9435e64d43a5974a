"""Geometry of one camera without depth: the start from two views, bundle adjustment, and the metric scale.

The functions take arrays of pixels, points and poses.  Frames, features and queries are in
`client_sdk.tracking`.
"""
