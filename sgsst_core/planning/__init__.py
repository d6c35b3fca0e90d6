"""Planning: measure a job before its first step, and decide what its scene allows to leave out."""
