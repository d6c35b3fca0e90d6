"""Fault-tolerant execution of one job on several ranks, which Ray starts as processes.

The driver starts sets of ranks until the job has ended and reports events (`attempts`), and decides what to do when a
rank is lost (`failure_policy`). It opens Ray and reserves resources (`cluster`), and starts, polls and ends ranks
(`rank_group`). `sweeper` cleans up after a killed driver.

`rank` is the process of a rank, `process_group` exchanges tensors between ranks, `messages` encodes other values, and
`shared_scene` shares the scene between the ranks of a machine.
"""
