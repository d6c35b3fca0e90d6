"""Judging a scene and a result: novel views, consistency, exactness, findings about inputs."""
