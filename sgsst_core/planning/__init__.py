"""Planning: measure a job before its first step, and decide what can be left out for its scene."""
