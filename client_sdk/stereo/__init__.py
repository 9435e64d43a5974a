"""Rectified stereo pairs and their depths.

Rigs, lenses and the rectification of images are in `client_sdk.rigs`; frames are tracked in
`client_sdk.tracking`.
"""
