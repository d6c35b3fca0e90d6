"""Planning: survey the views of a job, and decide what can be left out for its scene.

`survey` renders every view, `context` has the facts about machine and job and the objects that measure them, `choices`
each choice with its reasons, `measurement_choice` the measurements between the steps, and `plan` the result.
`stylizing.planner` makes the plan, with a trial of the job that it predicts its cost from.
"""
