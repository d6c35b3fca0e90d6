"""Planning: survey the views of a job, and decide what can be left out for its scene.

`survey` renders every view, `facts` describes machine, scene and views, `choices` makes the plan from facts and
settings alone, with the reason of each choice, and `plan` is the result. No module here reads a clock: the same command
makes the same plan. `time_budget` chooses for `--within`, from a pace that it is given.
"""
