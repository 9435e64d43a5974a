"""Everything that knows SLAM: poses, cameras, features, keyframes, places, links and graphs.

No socket, no file and no clock belongs here; messages of services belong to `rse_pf.services`.
"""
