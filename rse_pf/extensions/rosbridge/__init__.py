"""The rosbridge server: clients of rosbridge v2 call the platform's services through it, and exchange topics.

For each client the server connects a robot of the SDK with the client's own token, so that the platform
decides what the client may do.  Topics exist within this process only.  The bridge for ROS nodes is the
package `ros_bridge`.
"""
