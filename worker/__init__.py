"""One job, from its files to its files, on one rank or several.

`options` declares what can be asked for, `request` says what is, `inputs` reads it, `prepare` plans it, `description`
tells what was decided, `execute` runs it and writes the results; `previews` are pictures of a running job, `processes`
what the system knows of processes. `ranks` spreads a job over several processes.
"""
