"""Files of jobs: inputs by digest, artifacts, and the folder that a job's inputs are staged in."""
