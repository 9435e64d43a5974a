"""RSE-PF: a robust, secure, elastic cloud robotics platform for distributed visual SLAM."""
