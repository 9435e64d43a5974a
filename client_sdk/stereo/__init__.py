"""A rectified stereo pair, and the depths that it measures.

Rigs, lenses and how images are rectified are in `client_sdk.rigs`; frames are tracked in
`client_sdk.tracking`.
"""
