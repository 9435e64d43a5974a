"""The algorithms and data types of SLAM: features, keyframes, place recognition, loop closures, pose graphs.

No socket and no clock belongs here, and no file but the vocabulary of place recognition; messages of services
belong to `rse_pf.services`.  Cameras and SE(3) are in `rse_pf.geometry`, on which the solver of poses,
`rse_pf.pnp`, and this package build.
"""
