"""Stylization jobs, from input files to output files, on one rank or several.

`options` declares the options of a job and `request` holds the values of one. `inputs` reads the files, `prepare`
plans the work, `description` summarizes the plan, and `execute` runs the job and writes the results. `previews` saves
images of a running job, and `processes` identifies and ends processes. `ranks` runs a job in several processes.
"""
