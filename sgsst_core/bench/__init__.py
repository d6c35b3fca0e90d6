"""Measurements that a user can repeat on a scene and machine of their own."""
