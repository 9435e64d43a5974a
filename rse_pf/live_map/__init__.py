"""One map that robots make together while they drive: events in, poses and corrections out.

Nothing here knows the time, a store, a connection or a thread.
"""
