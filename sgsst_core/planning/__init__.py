"""Planning: survey the views of a job, and decide what can be left out for its scene.

No module here reads a clock: the same command makes the same plan.
"""
