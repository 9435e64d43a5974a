"""RSE-PF: a robust, secure, elastic cloud robotics platform for distributed visual SLAM.

Modules that several packages need belong at this level; everything else belongs in a package.
"""
