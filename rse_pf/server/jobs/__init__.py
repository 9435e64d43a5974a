"""Jobs: commands to long services, such as a merge of maps, each computed in a process of its own.

A job takes these steps:

1. `manager.JobManager` gets the command in the worker of the robot, and starts a thread for the job.
2. `runner.run_job` waits in that thread for a slot of the server (`slots`), and claims the lease of the job
   in the object store (`lease`), so that only one worker of all servers runs the job.
3. `process.run` computes the job in a process of its own, and stores the reply.
4. `record_gc` deletes old records of jobs.

The functions that jobs call belong to `rse_pf.services`, and commands that are answered within milliseconds
to `rse_pf.server.scheduling`.  Merges that operators distribute over several machines belong to
`rse_pf.extensions.batch`.
"""
