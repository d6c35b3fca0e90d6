"""Fault-tolerant execution of one job on several ranks, which Ray starts as processes.

The driver starts sets of ranks until the job has ended (`attempts`), and decides what to do when a rank is lost
(`failure_policy`). It opens Ray (`cluster`), reserves resources (`placement`, `host_memory`), starts, polls and ends
ranks (`starting`, `polling`, `ending`) and reports events (`listener`). `rank_group` holds the state of the current
set. `sweeper` cleans up after a killed driver or rank.

`rank` is the process of a rank, `process_group` exchanges tensors between ranks, `messages` encodes other values, and
`geometry` shares the scene between the ranks of a machine.
"""
