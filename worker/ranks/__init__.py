"""One job on several ranks, which Ray starts as processes: `driver` watches them, `cluster` is Ray and what it
reserves, `rank` is the process of a rank, and `process_group` exchanges tensors between ranks.
"""
