"""Inertial measurement units: samples, preintegration, and alignment with the poses of a camera.

1. `samples` holds the samples that come with a frame, and the model of the IMU; `history` collects those of
   the last five minutes.
2. `checks` refuses an IMU whose samples are faulty, or whose gyroscope contradicts the camera's rotations.
3. `preintegration` integrates the samples between two frames on the manifold (Forster et al. 2017).
4. `alignment` estimates metric scale, gravity, velocities and biases from tracked poses and preintegrated
   motions: the linear initialisation of VINS-Mono, then nonlinear least squares over all these poses.
5. `estimator` runs these steps over a drive, predicts the rotation between frames, and measures the direction
   of gravity and the motion that keyframes state.

Frames, tracking and messages belong to other packages; raw samples never leave the robot.
"""
