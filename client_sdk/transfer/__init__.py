"""Transfer objects and maps between a robot and the platform's data service over HTTP.

A transfer that was interrupted is resumed.  Large objects may go directly to or from the bucket, by a
presigned URL: it carries a signature for one transfer in place of the robot's token.  Commands travel on the
WebSocket of `client_sdk.network.connection` instead.
"""
