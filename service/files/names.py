"""Names of results that more than one module knows."""

#: The stylized scene; the other files of a job are named after it while it runs.
RESULT = "stylized.ply"
#: What an unfinished job goes on from; the dot keeps it from users' sight.
CHECKPOINT = ".checkpoint"
