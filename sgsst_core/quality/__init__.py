"""Judging a scene and a result: held-out views, consistency, exactness, findings about inputs."""
