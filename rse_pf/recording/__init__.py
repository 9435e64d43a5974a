"""Recordings of what robots and servers said: files of the format MCAP, which others read, too.

`file_format` says what is in a file, `writer` writes one, `tap` and `recorder_process` record on a server.
"""
