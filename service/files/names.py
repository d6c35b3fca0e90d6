"""Names of result files that several modules use."""

#: Name of the stylized scene; the names of a job's other files are derived from it.
RESULT = "stylized.ply"
#: Name of the checkpoint that an unfinished job resumes from; the leading dot hides it from users.
CHECKPOINT = ".checkpoint"
