"""Extensions: what the platform works without.  They import the core; the core imports none of them.

Experiments, load generators and injected faults, recording and replay of messages, the check of drives, the
fleet page, exports of maps, rosbridge, estimates of cost, and jobs on a cluster of Dask.  A verb of an
extension is its ``command``.
"""
