"""The rosbridge server: it speaks rosbridge v2 to its clients, and the platform's protocol to the platform.

For each client it connects a robot of the SDK with the client's own token, so that the platform decides what
the client may do.  Topics connect the clients of this process; ROS nodes belong to `ros_bridge`.
"""
