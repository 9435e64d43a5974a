"""The rosbridge v2 endpoint: robots that speak rosbridge call services and share topics.

It is a codec, a session and topics behind the admission, the scheduler and the limits of any robot.
"""
