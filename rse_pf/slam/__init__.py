"""Everything that knows SLAM: poses, cameras, features, keyframes, places, links and graphs.

No socket, no file and no clock belongs here; messages of services belong to `rse_pf.services`.  Cameras and
SE(3) are in `rse_pf.geometry`, which stands below the solver of poses, `rse_pf.pnp`.
"""
