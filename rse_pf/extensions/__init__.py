"""Extensions: what the platform works without.  They import the core; the core imports none of them.

Experiments and load generators, recording and replay of messages, the check of drives, the fleet
page, exports of maps, rosbridge, and jobs on a cluster of Dask.  A verb of an extension is its ``command``.
"""
