"""Which command a worker computes next, and how its event loop and its threads divide the work.

This package has the scheduler, the overload control, the interface of queues, the decoder thread, and the
limits of time within one round of the event loop.  Computing and answering a command belong to `gateway`.
"""
