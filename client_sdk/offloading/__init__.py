"""Who computes a pose: a server, the burst function, or the robot itself."""
