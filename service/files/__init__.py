"""Files of jobs: inputs stored by digest, result files, and the folder in which a job's inputs are staged."""
