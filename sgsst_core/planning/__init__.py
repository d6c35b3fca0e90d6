"""Planning: measure a job before its first step, and decide what can be left out for its scene.

`planner.make_plan` surveys the views (`survey`), creates the objects to measure with (`context`), measures facts
(`probe`, `facts`), and decides (`decide`): `choices` has each choice with its reasons, `cost` predicts seconds and
bytes, `measuring` limits the time of measurements, and `plan` has the result.
"""
