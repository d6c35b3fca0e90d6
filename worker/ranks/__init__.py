"""One job on several ranks, which Ray starts as processes: `driver` watches them, `cluster` is Ray and what it
reserves, and `process_group` exchanges tensors between ranks. `worker.run` has the process of a rank.
"""
