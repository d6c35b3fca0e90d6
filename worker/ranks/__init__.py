"""A job on several ranks, whatever becomes of them.

The driver: `attempts` starts sets of ranks until the job has ended, and `failure_policy` decides what to do when one
was lost. It goes through `cluster` (Ray, started or joined), `placement` (by `host_memory`), `starting`, `polling`,
`listener` (who is told) and `ending`; `rank_group` is what it knows of the present set. `sweeper` cleans up after a
killed driver or rank.

A rank: `rank` is its process, `process_group` what carries tensors between ranks, `geometry` the scene that the ranks
of a machine share.
"""
